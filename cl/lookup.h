/* Range lines read between their samples, where every lane has a position of its own.
 *
 * The speed of backprojection is limited by how fast samples are fetched, so there are four ways to do it:
 *   - with WIDTH 1 a work-item reads its samples, real and imaginary parts at once;
 *   - with more lanes, every lane reads its samples one by one;
 *   - with HAS_PICK (x86.h) and AVX-512, lanes pick their samples from two vectors of consecutive ones of each part, which
 *     contain the samples of all taps, and for which there are enough registers (32);
 *   - with HAS_PICK and AVX2 (16 registers), one or two vectors are loaded for each tap.
 * Picking is two to four times as fast as reading one by one. The host asks for it if the positions of all lanes of a
 * block lie within a window.
 *
 * Build options
 *   PERMUTE  vectors from which lanes pick, 1 or 2 (2 with AVX-512), or 0.
 *   TAPS     samples per interpolation, an even number.
 *   WINDOWS  windows for the blocks of a work-item: 1, 2 or 4. Without HAS_PICK there are none, and it counts as 1.
 */

#include "interpolation.h"
#include "samples.h"

#if HAS_PICK

/* POSITIONS: number of adjacent whole samples at which the taps of a lane can start in a window of WINDOW_SAMPLES
 * samples. */
#if AVX == 512
#define POSITIONS (2 * WIDTH - TAPS + 1)
#define WINDOW_SAMPLES (2 * WIDTH)
#else
#define POSITIONS (PERMUTE * WIDTH)
#define WINDOW_SAMPLES (PERMUTE * WIDTH + TAPS - 1)
#endif

/* A window of a line. Positions are in samples from a reference sample of the line, less 0.5. The integer part of a position
 * plus `first` is the number, in the window, of the first of its taps. */
typedef struct {
#if AVX == 512
    vfloat re_low, re_high, im_low, im_high;
#else
    __global const sample_t *samples;
    int pitch;
#endif
    int first;
} Lookup;

INLINE Lookup lookup_from(__global const sample_t *window, int pitch, int first)
{
#if AVX == 512
    return (Lookup){LOAD_PARTS(window), LOAD_PARTS(window + WIDTH), LOAD_PARTS(window + pitch),
                    LOAD_PARTS(window + pitch + WIDTH), first};
#else
    return (Lookup){window, pitch, first};
#endif
}

/* One value for each of up to 4 windows. */
typedef union {
    int4 all;
    int of[4];
} Numbers;

/* Where windows start in their line, and `first` of each (see Lookup). */
typedef struct {
    Numbers start, first;
} Windows;

/* The windows about positions t from sample `reference`. They lie within the line for every t. */
INLINE Windows windows_about(float4 t, int reference, int pitch)
{
    const int4 lowest = as_int4((t - 0.5f * (POSITIONS - 1)) + ROUNDER) - 0x4B400000;
    const int4 start = lowest + (reference + 1 - TAPS / 2);
    Windows windows;
    windows.start.all = CLAMP(start, (int4)0, (int4)(pitch - WINDOW_SAMPLES));
    windows.first.all = -lowest;
    return windows;
}

INLINE Lookup lookup_in(const Windows *windows, int number, __global const sample_t *line, int pitch)
{
    return lookup_from(line + windows->start.of[number], pitch, windows->first.of[number]);
}

INLINE Lookup lookup_about(__global const sample_t *line, int pitch, int reference, float t)
{
    const int lowest = ROUNDED_INT(t - 0.5f * (POSITIONS - 1));
    const int start = reference + lowest + 1 - TAPS / 2;
    return lookup_from(line + CLAMP(start, 0, pitch - WINDOW_SAMPLES), pitch, -lowest);
}

/* The samples under the taps of every lane, for positions rounded by adding ROUNDER. */
typedef struct {
    const Lookup *lookup;
    vint index;
} Taps;

INLINE Taps fetch_taps(const Lookup *lookup, vfloat shifted)
{
    /* Picking ignores all but the lowest bits of an index, so those of ROUNDER need not be removed. */
    return (Taps){lookup, AS_VINT(shifted) + lookup->first};
}

#if AVX == 512
#define TAP_RE(taps, k) pick_of_two((taps).lookup->re_low, (taps).lookup->re_high, (taps).index + (k))
#define TAP_IM(taps, k) pick_of_two((taps).lookup->im_low, (taps).lookup->im_high, (taps).index + (k))
#else
/* Samples from an index on. */
INLINE vfloat samples_from(__global const sample_t *sample, vint index)
{
#if PERMUTE == 1
    return pick(LOAD_PARTS(sample), index);
#else
    return pick_of_two(LOAD_PARTS(sample), LOAD_PARTS(sample + WIDTH), index);
#endif
}
#define TAP_RE(taps, k) samples_from((taps).lookup->samples + (k), (taps).index)
#define TAP_IM(taps, k) samples_from((taps).lookup->samples + (taps).lookup->pitch + (k), (taps).index)
#endif

#else
#undef WINDOWS
#define WINDOWS 1

typedef struct {
    __global const sample_t *line;
    int pitch;
    int first;
} Lookup;

typedef int Windows;

INLINE Windows windows_about(float4 t, int reference, int pitch)
{
    return reference;
}

INLINE Lookup lookup_in(const Windows *windows, int number, __global const sample_t *line, int pitch)
{
    return (Lookup){line, pitch, *windows + 1 - TAPS / 2};
}

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
    /* Positions outside the line are moved inside, where the host has put zeros. */
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

/* Interpolates the line at t + 0.5 samples from the reference sample of the lookup. Because of the 0.5, rounding t finds the
 * lower of the two middle taps. */
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
