/* Reports the vectors of the device's compiler, according to the macros that it defines. The host does not run the kernel
 * but reads its required work-group size: along x the floats of a vector; along y 2 if the compiler can permute them in
 * registers (x86.h), else 1.
 *
 * The driver reports the vectors of the processor, but if the processor is newer than the driver, its compiler may use
 * shorter ones, and vectors longer than the compiler's break it.
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
