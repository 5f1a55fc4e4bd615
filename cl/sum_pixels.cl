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
 * filters  float [PHASES + 2][2][taps][2], with an even number of taps: the real parts, each twice, and then the
 *          imaginary parts, each twice.
 * whole, fraction, factors  [channels][points]. Pairs whose factor is 0 are skipped.
 *
 * Global size: (groups of points, groups of channels).
 */

/* 2 samples, of which those outside the line are 0. */
inline float4 samples_near_end(__global const float2 *line, int first, int length)
{
    const float2 none = 0.0f;
    return (float4)(first >= 0 && first < length ? line[first] : none,
                    first + 1 >= 0 && first + 1 < length ? line[first + 1] : none);
}

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
            const bool inside = first >= 0 && first + taps <= length;
            const float phase = fraction[pair] * PHASES;
            const int entry = clamp((int)phase, 0, PHASES);
            const float share = phase - entry;
            __global const float *row = filters + (size_t)entry * 4 * taps;
            float4 by_real = 0.0f, by_imaginary = 0.0f;
            for (int v = 0; v < taps / 2; v++) {
                const float4 sample = inside ? vload4(0, (__global const float *)(line + first + 2 * v))
                                             : samples_near_end(line, first + 2 * v, length);
                const float4 real = vload4(v, row), imaginary = vload4(v + taps / 2, row);
                const float4 next_real = vload4(v + taps, row), next_imaginary = vload4(v + 3 * taps / 2, row);
                by_real += sample * (real + share * (next_real - real));
                by_imaginary += sample * (imaginary + share * (next_imaginary - imaginary));
            }
            const float x = by_real.x + by_real.z - (by_imaginary.y + by_imaginary.w);
            const float y = by_real.y + by_real.w + (by_imaginary.x + by_imaginary.z);
            sum[point - first_point] += (float2)(x * factor.x - y * factor.y, x * factor.y + y * factor.x);
        }
    }
    for (int point = first_point; point < last_point; point++)
        sums[(size_t)group * points + point] = sum[point - first_point];
}
