/* Arithmetic peak of a device: every work-item runs 16 independent chains of multiply-adds on vectors of WIDTH floats,
 * which is steps * 16 * WIDTH * 2 floating-point operations.
 *
 * result: float [items]; a sum that keeps the compiler from dropping the work.
 */

#include "vectors.h"

__kernel void peak(int steps, float factor, __global float *result)
{
    vfloat chain[16];
#pragma unroll
    for (int k = 0; k < 16; k++)
        chain[k] = (float)(k + get_global_id(0));
    for (int step = 0; step < steps; step++) {
#pragma unroll
        for (int k = 0; k < 16; k++)
            chain[k] = chain[k] * factor + 0.5f;
    }
    vfloat sum = 0.0f;
#pragma unroll
    for (int k = 0; k < 16; k++)
        sum += chain[k];
#if WIDTH == 1
    result[get_global_id(0)] = sum;
#else
    result[get_global_id(0)] = sum.s0 + sum.s3;
#endif
}
