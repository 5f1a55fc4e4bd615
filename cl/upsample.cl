/* Upsampling: every line, turned by a constant frequency, at PHASES/step times its rate,
 *
 *     y(m) = sum_t h_p(t) x(q + 1 - TAPS/2 + t) exp(-j 2 pi turn (q + 1 - TAPS/2 + t)),
 *
 * where (first + m) step = q PHASES + p, 0 <= p < PHASES: y(m) lies at (first + m) step / PHASES of x, and h_p is the
 * filter for the part of a sample that p is. Beyond its ends a line is zero.
 *
 * Build options
 *   WIDTH    lanes: consecutive samples of y (common.h).
 *   TAPS     of the filters, even.
 *   PHASES   a multiple of WIDTH.
 *   PERMUTE  take lanes' samples from two registers (where the compiler can: common.h).
 *   TURN     0: turn is 0.
 *   HALF     1: y is of half in place of float (common.h).
 *
 * Buffers
 *   samples  float2 [lines at work][count].
 *   filter   float [PHASES / WIDTH][TAPS][WIDTH]: lane by lane the filters of samples m, m + 1, ... from
 *            multiples of WIDTH on.
 *   lines    [lines][2][pitch] of `held`, real parts and imaginary ones; with WIDTH 1 interleaved, from number
 *            first_line on: y in `length` samples from number `margin` on, zeros in the others. `margin` and
 *            `pitch` are multiples of WIDTH.
 *   turn     2^-32 cycles per sample of x.
 *
 * Global size: (work-items that share a line, lines at work).
 */

#ifdef WINDOW
#if WIDTH == 16
#define INT_LANES ((vint)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))
#define EVEN 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30
#define ODD 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31
#else
#define INT_LANES ((vint)(0, 1, 2, 3, 4, 5, 6, 7))
#define EVEN 0, 2, 4, 6, 8, 10, 12, 14
#define ODD 1, 3, 5, 7, 9, 11, 13, 15
#endif
#endif

/* The sample of x at an index, turned. */
INLINE float2 sample_at(__global const float2 *samples, int count, int index, int turn)
{
    if (index < 0 || index >= count)
        return (float2)(0.0f, 0.0f);
    const float2 x = samples[index];
#if TURN
    /* Whole cycles overflow. */
    const float cycles = (int)((uint)turn * (uint)index) * -0x1p-32f;
    float cosine;
    const float sine = sincos(cycles * 6.2831853f, &cosine);
    return (float2)(x.x * cosine - x.y * sine, x.x * sine + x.y * cosine);
#else
    return x;
#endif
}

#ifdef WINDOW
/* WIDTH samples from an index on, turned, as real and imaginary parts. */
INLINE void load_turned(__global const float2 *samples, int count, int index, int turn, vfloat *re, vfloat *im)
{
    if (index >= 0 && index + WIDTH <= count) {
        __global const float *x = (__global const float *)(samples + index);
        const vfloat low = LOAD(x), high = LOAD(x + WIDTH);
        const vfloat a = __builtin_shufflevector(low, high, EVEN), b = __builtin_shufflevector(low, high, ODD);
#if TURN
        const float begin = (int)((uint)turn * (uint)index) * -0x1p-32f;
        vfloat sine, cosine;
        sincos_cycles(begin + LANES * (turn * -0x1p-32f), &sine, &cosine);
        *re = a * cosine - b * sine;
        *im = a * sine + b * cosine;
#else
        *re = a;
        *im = b;
#endif
        return;
    }
    for (int lane = 0; lane < WIDTH; lane++) {
        const float2 x = sample_at(samples, count, index + lane, turn);
        ((float *)re)[lane] = x.x;
        ((float *)im)[lane] = x.y;
    }
}
#endif

#if WIDTH == 1
#define PUT(re, im) STORE_HELD(re, lines + 2 * at), STORE_HELD(im, lines + 2 * at + 1)
#else
#define PUT(re, im) STORE_HELD(re, lines + at), STORE_HELD(im, lines + at + pitch)
#endif

__kernel void upsample_lines(__global const float2 *samples, int count, __global const float *filter, int first, int step,
                       int turn, __global held *lines, int first_line, int pitch, int margin, int length)
{
    samples += (size_t)get_global_id(1) * count;
    lines += (size_t)(first_line + get_global_id(1)) * 2 * pitch;
    const int items = get_global_size(0);
    for (int at = get_global_id(0) * WIDTH; at < pitch; at += items * WIDTH) {
        const int m = at - margin;
        if (m < 0 || m >= length) {
            PUT(0.0f, 0.0f);
            continue;
        }
        const int vector = m / WIDTH;
        const int phase = vector % (PHASES / WIDTH) * WIDTH;
        /* Rounded down; (first + m) step + far PHASES is not negative. As an int it holds lines of up to
         * 2^31 / PHASES samples, given ones. */
        const int far = 1 << 20;
        const int place = (first + vector * WIDTH) * step + far * PHASES;
        const int begin = place / PHASES - far + 1 - TAPS / 2;
        __global const float *h = filter + phase * TAPS;
        vfloat re = 0.0f, im = 0.0f;
#ifdef WINDOW
        const int part = place % PHASES;
        const vint away = (part + step * INT_LANES) / PHASES;
        vfloat re_low, im_low, re_high, im_high;
        load_turned(samples, count, begin, turn, &re_low, &im_low);
#pragma unroll
        for (int block = 0; block < TAPS; block += WIDTH) {
            load_turned(samples, count, begin + block + WIDTH, turn, &re_high, &im_high);
#pragma unroll
            for (int t = 0; t < WIDTH && block + t < TAPS; t++) {
                const vfloat weight = LOAD(h + (block + t) * WIDTH);
                re += weight * PICK(re_low, re_high, away + t);
                im += weight * PICK(im_low, im_high, away + t);
            }
            re_low = re_high;
            im_low = im_high;
        }
#else
        for (int lane = 0; lane < WIDTH; lane++) {
            const int from = begin + (place % PHASES + lane * step) / PHASES;
            float2 sum = (float2)(0.0f, 0.0f);
            for (int t = 0; t < TAPS; t++)
                sum += h[t * WIDTH + lane] * sample_at(samples, count, from + t, turn);
            ((float *)&re)[lane] = sum.x;
            ((float *)&im)[lane] = sum.y;
        }
#endif
#if WIDTH == 1
        PUT(re, im);
#else
        const vfloat last = length - 1 - m;
        PUT(LANES <= last ? re : (vfloat)0.0f, LANES <= last ? im : (vfloat)0.0f);
#endif
    }
}
