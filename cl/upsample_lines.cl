/* Upsampling of range lines: shifts every line in frequency, and samples it at PHASES / step times its rate,
 *
 *     y(m) = sum_t h_p(t) x(q + 1 - TAPS/2 + t) exp(-j 2 pi frequency (q + 1 - TAPS/2 + t)),
 *
 * where (first + m) step = q PHASES + p, 0 <= p < PHASES. So y(m) lies at sample (first + m) step / PHASES of x, and h_p is
 * the filter for the fraction p / PHASES of a sample. Beyond its ends a line is zero.
 *
 * Build options: WIDTH (vectors.h; lanes are consecutive samples of y), PERMUTE (x86.h; lanes then pick their samples from
 * two registers), HALF (samples.h; for y), PHASE_TERMS (phases.h), and
 *   TAPS             of the filters, even.
 *   PHASES           a multiple of WIDTH.
 *   FREQUENCY_SHIFT  0: frequency is 0.
 *
 * samples           float2 [lines at work][count].
 * filters           float [PHASES / WIDTH][TAPS][WIDTH]: the filters of WIDTH consecutive samples from each multiple m of
 *                   WIDTH on, one for each lane.
 * phase_polynomials see phases.h.
 * frequency         2^-32 cycles per sample of x, with FREQUENCY_SHIFT.
 * lines, pitch      the upsampled lines (samples.h), from line number first_line on: y in `length` samples from number
 *                   `margin` on, zeros in the others. `margin` and `pitch` are multiples of WIDTH.
 *
 * Global size: (work-items that share a line, lines at work).
 */

#include "phases.h"
#include "samples.h"

/* Numbers of all lanes, and of every other one of two vectors. */
#define INT_LANES ((vint)JOIN(INT_LANES_, WIDTH))
#define INT_LANES_8 (0, 1, 2, 3, 4, 5, 6, 7)
#define INT_LANES_16 (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)
#define EVEN JOIN(EVEN_, WIDTH)
#define EVEN_8 0, 2, 4, 6, 8, 10, 12, 14
#define EVEN_16 EVEN_8, 16, 18, 20, 22, 24, 26, 28, 30
#define ODD JOIN(ODD_, WIDTH)
#define ODD_8 1, 3, 5, 7, 9, 11, 13, 15
#define ODD_16 ODD_8, 17, 19, 21, 23, 25, 27, 29, 31

/* A given line, of `count` samples, and the shift in frequency that it takes. */
typedef struct {
    __global const float2 *samples;
    int count;
#if FREQUENCY_SHIFT
    int frequency;
    __global const float *phase_polynomials;
#endif
} Given;

#if FREQUENCY_SHIFT
/* Phase of the shift at a sample, in cycles. Whole cycles overflow, and so do not matter. */
INLINE float phase_at(const Given *given, int index)
{
    return (int)((uint)given->frequency * (uint)index) * -0x1p-32f;
}
#endif

/* One sample of x, shifted in frequency. */
INLINE float2 sample_at(const Given *given, int index)
{
    if (index < 0 || index >= given->count)
        return (float2)(0.0f, 0.0f);
    const float2 x = given->samples[index];
#if FREQUENCY_SHIFT
    vfloat sine, cosine;
    sine_and_cosine(phase_at(given, index), given->phase_polynomials, &sine, &cosine);
    const float s = LANE(sine, 0), c = LANE(cosine, 0);
    return (float2)(x.x * c - x.y * s, x.x * s + x.y * c);
#else
    return x;
#endif
}

#if HAS_PICK
/* WIDTH samples of x from an index on, shifted in frequency, as real and imaginary parts. */
INLINE void load_samples(const Given *given, int index, vfloat *re, vfloat *im)
{
    if (index >= 0 && index + WIDTH <= given->count) {
        __global const float *x = (__global const float *)(given->samples + index);
        const vfloat low = LOAD(x), high = LOAD(x + WIDTH);
        const vfloat a = __builtin_shufflevector(low, high, EVEN), b = __builtin_shufflevector(low, high, ODD);
#if FREQUENCY_SHIFT
        vfloat sine, cosine;
        sine_and_cosine(phase_at(given, index) + LANES * (given->frequency * -0x1p-32f), given->phase_polynomials, &sine,
                        &cosine);
        *re = a * cosine - b * sine;
        *im = a * sine + b * cosine;
#else
        *re = a;
        *im = b;
#endif
        return;
    }
    for (int lane = 0; lane < WIDTH; lane++) {
        const float2 x = sample_at(given, index + lane);
        LANE(*re, lane) = x.x;
        LANE(*im, lane) = x.y;
    }
}

/* WIDTH samples of y. Tap 0 of lane n lies at sample begin + (fraction + n step) / PHASES of x. */
INLINE void filter_lanes(const Given *given, __global const float *filter, int begin, int fraction, int step, vfloat *re,
                         vfloat *im)
{
    const vint first = (fraction + step * INT_LANES) / PHASES;
    vfloat re_low, im_low, re_high, im_high;
    load_samples(given, begin, &re_low, &im_low);
#pragma unroll
    for (int block = 0; block < TAPS; block += WIDTH) {
        load_samples(given, begin + block + WIDTH, &re_high, &im_high);
#pragma unroll
        for (int t = 0; t < WIDTH && block + t < TAPS; t++) {
            const vfloat weight = LOAD(filter + (block + t) * WIDTH);
            *re += weight * pick_of_two(re_low, re_high, first + t);
            *im += weight * pick_of_two(im_low, im_high, first + t);
        }
        re_low = re_high;
        im_low = im_high;
    }
}
#else
INLINE void filter_lanes(const Given *given, __global const float *filter, int begin, int fraction, int step, vfloat *re,
                         vfloat *im)
{
    for (int lane = 0; lane < WIDTH; lane++) {
        const int first = begin + (fraction + lane * step) / PHASES;
        float2 sum = (float2)(0.0f, 0.0f);
        for (int t = 0; t < TAPS; t++)
            sum += filter[t * WIDTH + lane] * sample_at(given, first + t);
        LANE(*re, lane) = sum.x;
        LANE(*im, lane) = sum.y;
    }
}
#endif

__kernel void upsample_lines(__global const float2 *samples, int count, __global const float *filters, int first, int step,
#if FREQUENCY_SHIFT
                             int frequency, __global const float *phase_polynomials,
#endif
                             __global sample_t *lines, int first_line, int pitch, int margin, int length)
{
#if FREQUENCY_SHIFT
    const Given given = {samples + (size_t)get_global_id(1) * count, count, frequency, phase_polynomials};
#else
    const Given given = {samples + (size_t)get_global_id(1) * count, count};
#endif
    __global sample_t *line = LINE(lines, first_line + get_global_id(1), pitch);
    const int items = get_global_size(0);
    for (int k = get_global_id(0) * WIDTH; k < pitch; k += items * WIDTH) {
        const int m = k - margin;
        vfloat re = 0.0f, im = 0.0f;
        if (m >= 0 && m < length) {
            /* An offset of whole samples keeps positions from being negative, so that division rounds down. Positions fit an
             * int for lines of up to 2^31 / PHASES samples. */
            const int offset = 1 << 20;
            const int position = (first + m) * step + offset * PHASES;
            const int begin = position / PHASES - offset + 1 - TAPS / 2;
            const int phase = m % PHASES;
            filter_lanes(&given, filters + phase * TAPS, begin, position % PHASES, step, &re, &im);
#if WIDTH > 1
            const vfloat last = length - 1 - m;
            re = LANES <= last ? re : (vfloat)0.0f;
            im = LANES <= last ? im : (vfloat)0.0f;
#endif
        }
        STORE_RE(re, line, k, pitch);
        STORE_IM(im, line, k, pitch);
    }
}
