/* Measures the arithmetic peak of a device. Every work-item computes CHAINS independent chains of multiply-adds on vectors
 * of WIDTH floats, which takes steps * CHAINS * WIDTH * 2 floating-point operations.
 *
 * result: float [items], sums that keep the compiler from removing the work.
 *
 * Build options
 *   CHAINS  number of chains. Too few do not hide the latency of a multiply-add; too many do not fit the registers.
 */

#include "vectors.h"

__kernel void peak(int steps, float factor, __global float *result)
{
    vfloat chain[CHAINS];
#pragma unroll
    for (int k = 0; k < CHAINS; k++)
        chain[k] = (float)(k + get_global_id(0));
    for (int step = 0; step < steps; step++) {
#pragma unroll
        for (int k = 0; k < CHAINS; k++)
            chain[k] = chain[k] * factor + 0.5f;
    }
    vfloat sum = 0.0f;
#pragma unroll
    for (int k = 0; k < CHAINS; k++)
        sum += chain[k];
#if WIDTH == 1
    result[get_global_id(0)] = sum;
#else
    result[get_global_id(0)] = sum.s0 + sum.s3;
#endif
}
