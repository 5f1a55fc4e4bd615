/* Second half of a stage of factorized backprojection: delay-and-sum of aligned lines into fewer, virtual
 * channels,
 *
 *     v_m(k) = sum_n a_nm s_n(k),
 *
 * where a interpolates the aperture: channel n contributes to TAPS consecutive virtual channels. With the
 * channels in the order of their virtual channels one pass suffices: TAPS sums are open at a time.
 *
 * Build options: WIDTH, lanes: consecutive samples of a line; TAPS, even (filter_weights in common.h).
 */

/* The weights of every (child, channel), float [children][channels][TAPS], at nu, float
 * [children][channels]. Global size (channels, children). */
__kernel void aperture_weights(__global const float *nu, __global const float *filter,
                               __global float *weights)
{
    const size_t place = get_global_id(1) * get_global_size(0) + get_global_id(0);
    float weight[TAPS];
    filter_weights(filter, nu[place], weight);
#pragma unroll
    for (int t = 0; t < TAPS; t++)
        weights[place * TAPS + t] = weight[t];
}

/* Global size (length / WIDTH, children).
 *   aligned  lines [children][channels][2][length] as of align.cl
 *   order    int [children][channels]: channels in the order of their virtual channels
 *   first    int [children][nodes + 1]: where in `order` the channels begin whose first virtual channel
 *            is the i-th
 *   weights  of aperture_weights
 *   virtual  lines [children][nodes][2][pitch], written from sample `offset` on */
__kernel void combine(__global const float *aligned, int length, int channels,
                      __global const int *order, __global const int *first,
                      __global const float *weights, int nodes, __global float *virtual_lines, int pitch,
                      int offset)
{
    const int k = get_global_id(0) * WIDTH;
    const int child = get_global_id(1);
    aligned += (size_t)child * channels * 2 * length;
    order += (size_t)child * channels;
    weights += (size_t)child * channels * TAPS;
    first += (size_t)child * (nodes + 1);
    virtual_lines += (size_t)child * nodes * 2 * pitch;

    vfloat re[TAPS], im[TAPS];
#pragma unroll
    for (int t = 0; t < TAPS; t++)
        re[t] = im[t] = 0.0f;
    for (int node = 0; node < nodes; node++) {
        for (int place = first[node]; place < first[node + 1]; place++) {
            const int channel = order[place];
            __global const float *weight = weights + (size_t)channel * TAPS;
            __global const float *line = aligned + (size_t)channel * 2 * length;
#if WIDTH == 1
            const vfloat a = line[2 * k], b = line[2 * k + 1];
#else
            const vfloat a = LOAD(line + k), b = LOAD(line + k + length);
#endif
#pragma unroll
            for (int t = 0; t < TAPS; t++) {
                re[t] += weight[t] * a;
                im[t] += weight[t] * b;
            }
        }
        /* No later channel reaches this virtual channel. */
        __global float *line = virtual_lines + (size_t)node * 2 * pitch;
#if WIDTH == 1
        line[2 * (k + offset)] = re[0];
        line[2 * (k + offset) + 1] = im[0];
#else
        STORE(re[0], line + k + offset);
        STORE(im[0], line + k + offset + pitch);
#endif
#pragma unroll
        for (int t = 0; t + 1 < TAPS; t++) {
            re[t] = re[t + 1];
            im[t] = im[t + 1];
        }
        re[TAPS - 1] = im[TAPS - 1] = 0.0f;
    }
}
