/* First half of a stage of factorized backprojection: brings the lines of a parent subimage to the centre
 * of each child,
 *
 *     a_n(k) = exp(j 2 pi cycles_n) sum_t h_t(nu_n) s_n(start_n + k + t).
 *
 * A constant shift of a line is a short filter over contiguous samples: nothing is gathered.
 *
 * Build options
 *   WIDTH   lanes: consecutive samples of a line (common.h).
 *   TAPS    of the range interpolation h, even (filter_weights in common.h).
 *
 * Global size (channels, children).
 *   parent      lines, float, `parent_pitch` samples each: [parents][channels][2][parent_pitch], real
 *               parts and imaginary ones; with WIDTH 1 interleaved.
 *   parent_of   int [children]: each child's parent.
 *   start       int [children][channels]: parent sample of tap 0 for k = 0. Samples outside the parent's
 *               line are never read: the place is moved inside, where the host has put zeros.
 *   nu, cycles  float [children][channels].
 *   filter      float [TAPS / 2][2][TAPS / 2]: of filter_weights.
 *   aligned     lines [children][channels][2][length], `length` a multiple of WIDTH.
 */

#if WIDTH == 1
#define LOAD_RE(line, k, pitch) (line)[2 * (k)]
#define LOAD_IM(line, k, pitch) (line)[2 * (k) + 1]
#else
#define LOAD_RE(line, k, pitch) LOAD((line) + (k))
#define LOAD_IM(line, k, pitch) LOAD((line) + (k) + (pitch))
#endif

__kernel void align(__global const float *parent, int parent_pitch, __global const int *parent_of,
                    __global const int *start, __global const float *nu, __global const float *cycles,
                    __global const float *filter, __global float *aligned, int length)
{
    const int channel = get_global_id(0), channels = get_global_size(0);
    const int child = get_global_id(1);
    const size_t place = (size_t)child * channels + channel;
    __global const float *line =
        parent + ((size_t)parent_of[child] * channels + channel) * 2 * parent_pitch;
    aligned += place * 2 * length;

    float weight[TAPS];
    filter_weights(filter, nu[place], weight);
    vfloat sine, cosine;
    sincos_cycles(cycles[place], &sine, &cosine);

    for (int k = 0; k < length; k += WIDTH) {
        const int first = clamp(start[place] + k, 0, parent_pitch - TAPS - WIDTH);
        vfloat re = 0.0f, im = 0.0f;
#pragma unroll
        for (int t = 0; t < TAPS; t++) {
            re += weight[t] * LOAD_RE(line, first + t, parent_pitch);
            im += weight[t] * LOAD_IM(line, first + t, parent_pitch);
        }
#if WIDTH == 1
        aligned[2 * k] = re * cosine - im * sine;
        aligned[2 * k + 1] = re * sine + im * cosine;
#else
        STORE(re * cosine - im * sine, aligned + k);
        STORE(re * sine + im * cosine, aligned + k + length);
#endif
    }
}
