/* Sums the samples of channels at some pixels, to measure the error of an image (clsas/engine/certificate.py). Ranges,
 * phases and weights of all pairs come from the host. Nothing is shared with the kernels that form images.
 *
 *     sums[group][point] = sum over the channels of a group of  weight * exp(j 2 pi cycles) * sample at position,
 *
 * where the position in the line is `whole` + `fraction`, and lines are 0 beyond their ends. The filters are complex, for
 * PHASES fractions; between them they are interpolated linearly.
 *
 * Build options
 *   TAPS    taps of the filters, a multiple of 4
 *   PHASES  fractions of a sample for which there are filters
 *   GROUP   channels that a work-item adds up
 *
 * samples  float2 [channels][length].
 * taps     float [PHASES + 2][2][TAPS][2]: the real parts, each twice, and then the imaginary parts, each twice.
 * whole, fraction, cycles, weight  [channels][points]. Pairs of weight 0 are skipped.
 *
 * Global size: (points, groups).
 */

#define VECTORS (TAPS / 4) /* of 4 complex samples; longer vectors are passed wrongly where registers are shorter */

/* 4 samples, of which those outside the line are 0. */
inline float8 samples_near_end(__global const float2 *line, int first, int length)
{
    float2 sample[4];
    for (int k = 0; k < 4; k++)
        sample[k] = first + k >= 0 && first + k < length ? line[first + k] : (float2)(0.0f);
    return (float8)(sample[0], sample[1], sample[2], sample[3]);
}

inline float sum_of(float4 terms)
{
    return terms.x + terms.y + (terms.z + terms.w);
}

__kernel void sum_pixels(__global const float2 *samples, int length, __global const float *taps,
                         __global const int *whole, __global const float *fraction, __global const float *cycles,
                         __global const float *weight, int channels, __global float2 *sums)
{
    const int point = get_global_id(0), points = get_global_size(0), group = get_global_id(1);
    const int last = min((group + 1) * GROUP, channels);
    float2 sum = 0.0f;
    for (int channel = group * GROUP; channel < last; channel++) {
        const size_t pair = (size_t)channel * points + point;
        if (weight[pair] == 0.0f)
            continue;
        __global const float2 *line = samples + (size_t)channel * length;
        const int first = whole[pair] - (TAPS / 2 - 1);
        const bool inside = first >= 0 && first + TAPS <= length;
        const float phase = fraction[pair] * PHASES;
        const int entry = clamp((int)phase, 0, PHASES);
        const float share = phase - entry;
        __global const float *row = taps + (size_t)entry * 4 * TAPS;
        float8 by_real = 0.0f, by_imaginary = 0.0f;
        for (int v = 0; v < VECTORS; v++) {
            const float8 sample = inside ? vload8(0, (__global const float *)(line + first + 4 * v))
                                          : samples_near_end(line, first + 4 * v, length);
            const float8 real = vload8(v, row), imaginary = vload8(v + VECTORS, row);
            const float8 next_real = vload8(v + 2 * VECTORS, row), next_imaginary = vload8(v + 3 * VECTORS, row);
            by_real += sample * (real + share * (next_real - real));
            by_imaginary += sample * (imaginary + share * (next_imaginary - imaginary));
        }
        const float x = sum_of(by_real.even) - sum_of(by_imaginary.odd);
        const float y = sum_of(by_real.odd) + sum_of(by_imaginary.even);
        const float cosine = cospi(2.0f * cycles[pair]) * weight[pair], sine = sinpi(2.0f * cycles[pair]) * weight[pair];
        sum += (float2)(x * cosine - y * sine, x * sine + y * cosine);
    }
    sums[(size_t)group * points + point] = sum;
}
