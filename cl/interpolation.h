/* Weights of an interpolation filter between samples.
 *
 * An interpolation at nu in [-0.5, 0.5] samples from the middle of an even number of taps weighs the taps at
 * +-(pair + 0.5) by E(nu^2) +- nu O(nu^2), with polynomials E and O of its own for every pair.
 *
 * filter: float [taps / 2][2][taps / 2], per pair from the innermost the coefficients of E, then O, highest power first.
 */

#include "vectors.h"

/* Weights of the two taps of a pair: `upper` beyond the middle, `lower` before it. */
INLINE void pair_weights(__global const float *filter, const int taps, const int pair, vfloat nu, vfloat square,
                         vfloat *upper, vfloat *lower)
{
    __global const float *coefficient = filter + pair * taps;
    vfloat even = coefficient[0], odd = coefficient[taps / 2];
#pragma unroll
    for (int power = 1; power < taps / 2; power++) {
        even = even * square + coefficient[power];
        odd = odd * square + coefficient[taps / 2 + power];
    }
    *upper = even + odd * nu;
    *lower = even - odd * nu;
}

/* Weights of all taps, in the order of the samples. */
INLINE void filter_weights(__global const float *filter, const int taps, vfloat nu, vfloat *weight)
{
    const vfloat square = nu * nu;
#pragma unroll
    for (int pair = 0; pair < taps / 2; pair++)
        pair_weights(filter, taps, pair, nu, square, &weight[taps / 2 + pair], &weight[taps / 2 - 1 - pair]);
}
