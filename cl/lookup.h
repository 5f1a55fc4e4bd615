/* Looking a range line up between its samples, at a position of its own for every lane.
 *
 * Fetching the samples is what limits backprojection, so there are three ways to do it:
 *   - WIDTH 1: a work-item reads its samples, real and imaginary part at once;
 *   - several lanes: every lane reads its samples one by one;
 *   - with HAS_PICK (vectors.h): 2 WIDTH samples of each part are held in registers, a window, and lanes pick theirs.
 *     That is five times as fast with AVX-512, twice with AVX2. The host asks for it where the samples of all lanes of
 *     a block lie within the window.
 *
 * Build options
 *   TAPS     samples per interpolation: 2, 4, 6 or 8.
 *   WINDOWS  windows that the blocks of a work-item take: 1, 2 or 4. Without windows it counts as 1.
 */

#include "interpolation.h"
#include "samples.h"

#ifndef HAS_PICK
#undef WINDOWS
#define WINDOWS 1
#endif

#ifdef HAS_PICK

/* A window of a line. Positions are in samples from a reference sample of the line, less 0.5; `first` leads from a
 * position's integer part to the first of its taps in the window. */
typedef struct {
    vfloat re_low, re_high, im_low, im_high;
    int first;
} Lookup;

/* The window about position t from sample `reference`; within the line whatever t is. */
INLINE Lookup lookup_about(__global const sample_t *line, int pitch, int reference, float t)
{
    const int whole = ROUNDED_INT(t);
    __global const sample_t *window = line + CLAMP(reference + whole - (WIDTH - 1), 0, pitch - 2 * WIDTH);
    return (Lookup){LOAD_PARTS(window), LOAD_PARTS(window + WIDTH), LOAD_PARTS(window + pitch),
                    LOAD_PARTS(window + pitch + WIDTH), WIDTH - TAPS / 2 - whole};
}

/* The samples under the taps of every lane, for positions rounded by adding ROUNDER. */
typedef struct {
    const Lookup *window;
    vint index;
} Taps;

INLINE Taps fetch_taps(const Lookup *lookup, vfloat shifted)
{
    /* pick() ignores all but an index's lowest bits, so ROUNDER's bits may stay. */
    return (Taps){lookup, AS_VINT(shifted) + lookup->first};
}
#define TAP_RE(taps, k) pick((taps).window->re_low, (taps).window->re_high, (taps).index + (k))
#define TAP_IM(taps, k) pick((taps).window->im_low, (taps).window->im_high, (taps).index + (k))

#else

typedef struct {
    __global const sample_t *line;
    int pitch;
    int first;
} Lookup;

INLINE Lookup lookup_about(__global const sample_t *line, int pitch, int reference, float t)
{
    return (Lookup){line, pitch, reference + 1 - TAPS / 2};
}

#if WIDTH == 1
typedef struct {
    float2 sample[TAPS];
} Taps;
#define TAP_RE(taps, k) (taps).sample[k].x
#define TAP_IM(taps, k) (taps).sample[k].y
#else
typedef struct {
    vfloat re[TAPS], im[TAPS];
} Taps;
#define TAP_RE(taps, k) (taps).re[k]
#define TAP_IM(taps, k) (taps).im[k]
#endif

INLINE Taps fetch_taps(const Lookup *lookup, vfloat shifted)
{
    /* Positions outside the line move inside, where the host has put zeros. */
    const vint index = min(max(VINT_OF_SHIFTED(shifted) + lookup->first, (vint)0), (vint)(lookup->pitch - TAPS));
    Taps taps;
#if WIDTH == 1
#pragma unroll
    for (int k = 0; k < TAPS; k++)
        taps.sample[k] = LOAD_PAIR(lookup->line + 2 * (index + k));
#else
#pragma unroll
    for (int lane = 0; lane < WIDTH; lane++) {
        __global const sample_t *sample = lookup->line + INT_LANE(index, lane);
#pragma unroll
        for (int k = 0; k < TAPS; k++) {
            LANE(taps.re[k], lane) = LOAD_PART(sample + k);
            LANE(taps.im[k], lane) = LOAD_PART(sample + k + lookup->pitch);
        }
    }
#endif
    return taps;
}

#endif

/* The line at t + 0.5 samples from the reference sample of the lookup. The 0.5 makes rounding find the lower of the two
 * middle taps. */
INLINE void interpolate(const Lookup *lookup, vfloat t, __global const float *filter, vfloat *re, vfloat *im)
{
    const vfloat shifted = t + ROUNDER;
    const vfloat nu = t - (shifted - ROUNDER);
    const vfloat square = nu * nu;
    const Taps taps = fetch_taps(lookup, shifted);
    vfloat sum_re = 0.0f, sum_im = 0.0f;
#pragma unroll
    for (int pair = 0; pair < TAPS / 2; pair++) {
        vfloat upper, lower;
        pair_weights(filter, TAPS, pair, nu, square, &upper, &lower);
        /* One product at a time: a compiler does not fuse a sum of two products with what it is added to. */
        sum_re += upper * TAP_RE(taps, TAPS / 2 + pair);
        sum_re += lower * TAP_RE(taps, TAPS / 2 - 1 - pair);
        sum_im += upper * TAP_IM(taps, TAPS / 2 + pair);
        sum_im += lower * TAP_IM(taps, TAPS / 2 - 1 - pair);
    }
    *re = sum_re;
    *im = sum_im;
}
