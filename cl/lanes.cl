/* How many floats the compiler's vectors hold, as far as its own macros tell: the host reads it from the kernel's
 * required work-group size, without running it. A driver reports what the processor has, and on processors newer than
 * itself its compiler uses less: vectors of 16 then break it.
 */

#ifdef __AVX512F__
#define VECTOR 16
#else
#define VECTOR 8
#endif

__kernel __attribute__((reqd_work_group_size(VECTOR, 1, 1))) void lanes(__global int *nothing)
{
}
