/* Sine and cosine of phases in cycles.
 *
 * Polynomials of our own, because sin() and cos() of wide vectors are scalar code on some CPU drivers, and because
 * reducing radians loses bits that reducing cycles keeps.
 *
 * Build options
 *   PHASE_TERMS  terms of each polynomial: 4 err by -61 dB, 5 by -92 dB, 6 by -126 dB, and 7 as single precision does.
 *
 * phase_polynomials: float [2][PHASE_TERMS]. With r the phase less its nearest integer, sin(2 pi r) is r times the first
 * polynomial in r^2, and cos(2 pi r) is the second one; the coefficients come highest power first.
 */

#include "vectors.h"

/* sin and cos of 2 pi t for t in cycles, |t| < 2^22. */
INLINE void sine_and_cosine(vfloat t, __global const float *phase_polynomials, vfloat *sine, vfloat *cosine)
{
    const vfloat r = t - ROUNDED(t);
    const vfloat square = r * r;
    vfloat s = phase_polynomials[0], c = phase_polynomials[PHASE_TERMS];
#pragma unroll
    for (int power = 1; power < PHASE_TERMS; power++) {
        s = s * square + phase_polynomials[power];
        c = c * square + phase_polynomials[PHASE_TERMS + power];
    }
    *sine = s * r;
    *cosine = c;
}
