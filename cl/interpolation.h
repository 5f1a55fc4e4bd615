/* Weights of an interpolation filter between samples.
 *
 * The number of taps is even. For an interpolation at nu in [-0.5, 0.5] samples from their middle, the two taps of a pair,
 * at +-(pair + 0.5) samples, have the weights E(nu^2) +- nu O(nu^2). Every pair has its own polynomials E and O.
 *
 * filter: float [taps / 2][2][taps / 2]; for each pair, from the innermost one on, the coefficients of E and then of O,
 * highest powers first.
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
