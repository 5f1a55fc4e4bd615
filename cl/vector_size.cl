/* The vectors of the device's compiler, as far as its own macros tell. The host reads the required work-group size
 * without running the kernel: along x the floats of a vector; along y 2 if the compiler can permute them in registers
 * (vectors.h), else 1.
 *
 * A driver reports what the processor has. On processors newer than itself its compiler uses less, and vectors wider than
 * the compiler's break it.
 */

#ifdef __AVX512F__
#define SIZE 16, 2, 1
#elif defined(__AVX2__) && defined(__F16C__)
#define SIZE 8, 2, 1
#elif defined(__AVX__)
#define SIZE 8, 1, 1
#else
#define SIZE 4, 1, 1
#endif

__kernel __attribute__((reqd_work_group_size(SIZE))) void vector_size(__global int *unused)
{
}
