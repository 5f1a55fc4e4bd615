/* Sums the samples of channels at some pixels, to measure the error of an image (clsas/engine/certificate.py). Positions
 * and factors of all pairs come from the host. Nothing is shared with the kernels that form images.
 *
 *     sums[group][point] = sum over the channels of a group of  factor * sample at position,
 *
 * where the position in the line is `whole` + `fraction`, and lines are 0 beyond their ends. The filters are complex, for
 * PHASES fractions; between them they are interpolated linearly.
 *
 * Build options
 *   PHASES  fractions of a sample for which there are filters
 *   GROUP, POINTS  channels that a work-item adds up, and for how many points; neighbours read the same part of a line
 *
 * samples  float2 [channels][length].
 * filters  float [PHASES + 2][2][taps][2], with a multiple of 4 taps: the real parts, each twice, and then the
 *          imaginary parts, each twice.
 * whole, fraction, factors  [channels][points]. Pairs whose factor is 0 are skipped.
 *
 * Global size: (groups of points, groups of channels).
 */

/* 4 samples or taps, which need not be aligned. vload8 is a function call with some drivers, and three times slower. */
#ifdef __clang__
typedef float unaligned8 __attribute__((ext_vector_type(8), aligned(4)));
#define LOAD(p) (*(__global const unaligned8 *)(p))
#else
#define LOAD(p) vload8(0, p)
#endif

__kernel void sum_pixels(__global const float2 *samples, int length, __global const float *filters, int taps,
                         __global const int *whole, __global const float *fraction, __global const float2 *factors,
                         int channels, int points, __global float2 *sums)
{
    const int first_point = get_global_id(0) * POINTS, group = get_global_id(1);
    const int last_point = min(first_point + POINTS, points), last_channel = min((group + 1) * GROUP, channels);
    float2 sum[POINTS];
    for (int p = 0; p < POINTS; p++)
        sum[p] = 0.0f;
    for (int channel = group * GROUP; channel < last_channel; channel++) {
        __global const float2 *line = samples + (size_t)channel * length;
        for (int point = first_point; point < last_point; point++) {
            const size_t pair = (size_t)channel * points + point;
            const float2 factor = factors[pair];
            if (factor.x == 0.0f && factor.y == 0.0f)
                continue;
            const int first = whole[pair] - (taps / 2 - 1);
            const float phase = fraction[pair] * PHASES;
            const int entry = phase < PHASES ? (int)phase : PHASES;
            const float share = phase - entry;
            __global const float *row = filters + (size_t)entry * 4 * taps;
            float x = 0.0f, y = 0.0f;
            if (first >= 0 && first + taps <= length) {
                float8 by_real = 0.0f, by_imaginary = 0.0f;
                for (int v = 0; v < 2 * taps; v += 8) {
                    const float8 sample = LOAD((__global const float *)(line + first) + v);
                    const float8 real = LOAD(row + v), imaginary = LOAD(row + v + 2 * taps);
                    const float8 next_real = LOAD(row + v + 4 * taps), next_imaginary = LOAD(row + v + 6 * taps);
                    by_real += sample * (real + share * (next_real - real));
                    by_imaginary += sample * (imaginary + share * (next_imaginary - imaginary));
                }
                const float4 even = by_real.even - by_imaginary.odd, odd = by_real.odd + by_imaginary.even;
                x = even.x + even.y + even.z + even.w;
                y = odd.x + odd.y + odd.z + odd.w;
            } else
                for (int t = max(-first, 0); t < min(taps, length - first); t++) {
                    __global const float *tap = row + 2 * t;
                    const float real = tap[0] + share * (tap[4 * taps] - tap[0]);
                    const float imaginary = tap[2 * taps] + share * (tap[6 * taps] - tap[2 * taps]);
                    const float2 sample = line[first + t];
                    x += sample.x * real - sample.y * imaginary;
                    y += sample.y * real + sample.x * imaginary;
                }
            sum[point - first_point] += (float2)(x * factor.x - y * factor.y, x * factor.y + y * factor.x);
        }
    }
    for (int point = first_point; point < last_point; point++)
        sums[(size_t)group * points + point] = sum[point - first_point];
}
