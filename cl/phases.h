/* Sine and cosine of phases in cycles.
 *
 * They are computed by polynomials here, because some CPU drivers compute sin() and cos() of wide vectors in scalar code,
 * and because reducing radians to one period loses bits that reducing cycles keeps.
 *
 * Build options
 *   PHASE_TERMS  terms of each polynomial. Errors are -61 dB with 4 terms, -92 dB with 5, -126 dB with 6, and those of single
 *                precision with 7.
 *
 * phase_polynomials: float [2][PHASE_TERMS]. With r the phase minus the nearest integer, sin(2 pi r) is r times the first
 * polynomial in r^2, and cos(2 pi r) is the second one. Coefficients are in the order of falling powers.
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
