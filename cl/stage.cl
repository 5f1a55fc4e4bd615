/* A stage of factorized backprojection: the lines of a parent subimage become fewer, virtual lines of each
 * child,
 *
 *     v_m(k) = sum_n a_nm exp(j 2 pi (cycles_n + ramp_n (k - half))) sum_t h_t(nu_n) s_n(start_n + k + t),
 *
 * that is, every line is brought to the child's centre (a constant shift: a short filter h over contiguous
 * samples, and a phase), and summed with weights a that interpolate the aperture. The ramp makes up for
 * channels whose ranges grow a little faster or slower across the child than those on the track do. Channels come in the order
 * of the virtual channels they contribute to: channel n adds to APERTURE_TAPS consecutive ones from
 * base[n] on, so that as many sums are open at a time.
 *
 * Build options
 *   WIDTH          lanes: consecutive samples of a line, or consecutive channels (common.h).
 *   TAPS           of the range interpolation h, even (filter_weights in common.h).
 *   APERTURE_TAPS  of the aperture interpolation a, even; 1: channels are added to one virtual channel each.
 *   GIVEN          1: shifts and phases come from the host (the first stage, whose channels may be
 *                  anything); 0: from the positions of virtual channels.
 *   RAMP           1: phases vary along the lines (with GIVEN only); 0: every ramp is 0.
 *   CHUNK          channels whose weights are kept at a time; sums still open after them are handed on as well,
 *                  and taken up again.
 *   HALF           1: lines are of half in place of float, in and out (common.h).
 *
 * Buffers
 *   parent      lines of `held`, `parent_pitch` samples each: [...][2][parent_pitch], real parts and
 *               imaginary ones; with WIDTH 1 interleaved.
 *   children    int [roots][children_per_root][5]: the channels [begin, end) that the child uses; what to subtract
 *               from a channel to find its line among the parent's; the child's first virtual channel and how
 *               many it has. The children at work begin at number first_child, with a root.
 *   Per root and channel, [roots][channel_pitch]:
 *   base        int: the first virtual channel it contributes to, never decreasing.
 *   between     float: its place from the middle of the virtual channels it contributes to.
 *   GIVEN only  order (int: its line), start (int: parent sample of tap 0 for k = 0), nu, cycles and, with RAMP,
 *               ramp (float; cycles per sample).
 *   otherwise   parents    int [children_per_root]: which of the parents_per_root each child belongs to; either
 *                          of those at work has lines_per_parent lines.
 *               positions  float [roots][3][channel_pitch]: of channels, m from the root's centre.
 *               offsets    float [roots][children_per_root][6]: the parent's centre from the root's, the
 *                          child's from its parent's, m.
 *               drift      velocity of receivers over the sound speed: what motion in flight adds to the
 *                          range to x is -drift.(x - channel), to first order.
 *               parent_centre: sample of a parent line that is its subimage's centre.
 *   half_length: samples of a line before the one of the child's centre.
 *   filter, aperture_filter: coefficients of h and a (filter_weights in common.h).
 *   lines       [children at work][lines_per_child][2][pitch], samples `guard` to guard + length - 1 written,
 *               `length` a multiple of WIDTH.
 *
 * Work-groups (any size along axis 0; 1 with WIDTH > 1) form a child each, or with several groups along axis 1
 * `part_length` samples of it, a multiple of 8 WIDTH.
 * Samples outside the parent's line are never read: the place is moved inside, where the host has put zeros.
 */

#define BLOCK (WIDTH > 1 ? (GIVEN ? 16 : 8) * WIDTH : 1) /* long lines are fetched in long pieces */

#if WIDTH == 1
#define LOAD_RE(line, k, pitch) LOAD_HELD((line) + 2 * (k))
#define LOAD_IM(line, k, pitch) LOAD_HELD((line) + 2 * (k) + 1)
#define STORE_RE(value, line, k, pitch) STORE_HELD(value, (line) + 2 * (k))
#define STORE_IM(value, line, k, pitch) STORE_HELD(value, (line) + 2 * (k) + 1)
#define STORE_LOCAL(value, p) (*(p) = (value))
#define TOGETHER barrier(CLK_LOCAL_MEM_FENCE)
#else
#define LOAD_RE(line, k, pitch) LOAD_HELD((line) + (k))
#define LOAD_IM(line, k, pitch) LOAD_HELD((line) + (k) + (pitch))
#define STORE_RE(value, line, k, pitch) STORE_HELD(value, (line) + (k))
#define STORE_IM(value, line, k, pitch) STORE_HELD(value, (line) + (k) + (pitch))
#ifdef __clang__
#define STORE_LOCAL(value, p) (*(__local vfloat_anywhere *)(p) = (value))
#else
#define STORE_LOCAL(value, p) JOIN(vstore, WIDTH)(value, 0, p)
#endif
#define TOGETHER
#endif

/* sum_t weight[t] line[place + t]: of `low`, the vector at `place`, and `high`, the one after it. Loads that cross
 * cache lines are slow; shuffles by constants are not. */
#if defined(__clang__) && WIDTH >= 8
#define SLIDING
#if WIDTH == 16
#define SHIFTED(low, high, t)                                                                          \
    __builtin_shufflevector(low, high, t, t + 1, t + 2, t + 3, t + 4, t + 5, t + 6, t + 7, t + 8, t + 9, \
                            t + 10, t + 11, t + 12, t + 13, t + 14, t + 15)
#else
#define SHIFTED(low, high, t) \
    __builtin_shufflevector(low, high, t, t + 1, t + 2, t + 3, t + 4, t + 5, t + 6, t + 7)
#endif
INLINE vfloat filtered(const float *weight, vfloat low, vfloat high)
{
    /* One after the other, since a sum of two products is not fused with what it is added to. */
    vfloat sum = weight[0] * low;
    sum += weight[1] * SHIFTED(low, high, 1);
#if TAPS > 2
    sum += weight[2] * SHIFTED(low, high, 2);
    sum += weight[3] * SHIFTED(low, high, 3);
#endif
#if TAPS > 4
    sum += weight[4] * SHIFTED(low, high, 4);
    sum += weight[5] * SHIFTED(low, high, 5);
#endif
#if TAPS > 6
    sum += weight[6] * SHIFTED(low, high, 6);
    sum += weight[7] * SHIFTED(low, high, 7);
#endif
    return sum;
}
#endif

/* Lines of different channels lie apart: a CPU fetches those of the channel after the next meanwhile. */
#if defined(__clang__) && WIDTH > 1 && !defined(NO_PREFETCH) /* which simulators do not know */
#define PREFETCH(p) __builtin_prefetch((const void *)(size_t)(p))
#define AHEAD 4
#endif

#if GIVEN
#define PARENT_LINE(c) (parent + (size_t)order[chunk + (c)] * 2 * parent_pitch)
#else
#define PARENT_LINE(c) (parent + (size_t)(chunk + (c) - parents_first) * 2 * parent_pitch)
#endif

/* The line of virtual channel `node`. */
#define NODE_LINE(node) (lines + (size_t)((node) - first_node) * 2 * pitch + (WIDTH == 1 ? 2 : 1) * guard)
#define HAS(node) ((node) >= first_node && (node) < end_node)

__kernel void stage(__global const held *parent, int parent_pitch, __global const int *children, int first_child,
                    int children_per_root, __global const int *base, __global const float *between, int channel_pitch,
#if GIVEN
                    __global const int *order, __global const int *start, __global const float *nu,
                    __global const float *cycles,
#if RAMP
                    __global const float *ramp,
#endif
#else
                    __global const int *parents, int parents_per_root, int lines_per_parent,
                    __global const float *positions, __global const float *offsets, float4 drift,
                    float samples_per_m, float cycles_per_m, int parent_centre,
#endif
                    int half_length,
                    __global const float *filter, __global const float *aperture_filter, __global held *lines, int lines_per_child, int pitch,
                    int length, int part_length, int guard)
{
    __local float taps[TAPS][CHUNK], aperture[APERTURE_TAPS][CHUNK], cosine[CHUNK], sine[CHUNK];
#if RAMP
    __local float phase[CHUNK]; /* at the child's centre; cosine and sine are of the turn per WIDTH samples */
#endif
    __local int first[CHUNK];
#if WIDTH > 1
    vfloat aligned_re[BLOCK / WIDTH][CHUNK], aligned_im[BLOCK / WIDTH][CHUNK];
#else
    float aligned_re[1][CHUNK], aligned_im[1][CHUNK];
#endif

    const int item = get_local_id(0), items = get_local_size(0);
    const int from = get_group_id(1) * part_length, to = length - from < part_length ? length : from + part_length;
    const int root = get_group_id(0) / children_per_root, in_root = get_group_id(0) % children_per_root;
    const int child = first_child + get_group_id(0);
    children += 5 * child;
    const int begin = children[0], end = children[1], parents_first = children[2];
    const int first_node = children[3], end_node = first_node + children[4];
    lines += get_group_id(0) * lines_per_child * 2 * pitch;
    const int row = (first_child / children_per_root + root) * channel_pitch;
    base += row;
    between += row;
#if GIVEN
    order += row;
    start += row;
    nu += row;
    cycles += row;
#if RAMP
    ramp += row;
#endif
#else
    parent += (size_t)(root * parents_per_root + parents[in_root]) * lines_per_parent * 2 * parent_pitch;
    positions += 3 * row;
    offsets += 6 * child;
    const float dx = offsets[3], dy = offsets[4], dz = offsets[5];
    const float drifted = drift.x * dx + drift.y * dy + drift.z * dz;
#endif

    int chunk_node = first_node - APERTURE_TAPS + 1;
    for (int chunk = begin; chunk < end; chunk += CHUNK) {
        const int count = end - chunk < CHUNK ? end - chunk : CHUNK;
        TOGETHER;
        for (int c = item * WIDTH; c < count; c += items * WIDTH) {
#if GIVEN
            const vfloat away = LOAD(nu + chunk + c), turns = LOAD(cycles + chunk + c);
            for (int lane = 0; lane < WIDTH; lane++)
                first[c + lane] = start[chunk + c + lane];
#else
            /* The change of range from the parent's centre to the child's, without cancellation. */
            __global const float *position = positions + chunk + c;
            const vfloat x = offsets[0] - LOAD(position);
            const vfloat y = offsets[1] - LOAD(position + channel_pitch);
            const vfloat z = offsets[2] - LOAD(position + 2 * channel_pitch);
            const vfloat square = x * x + y * y + z * z;
            const vfloat more = dx * (2.0f * x + dx) + dy * (2.0f * y + dy) + dz * (2.0f * z + dz);
            const vfloat change =
                more / (sqrt(max(square + more, 0.0f)) + sqrt(square) + FLT_MIN) - drifted;
            const vfloat turns = change * cycles_per_m;
            const vfloat shift = change * samples_per_m - 0.5f;
            const vfloat shifted = shift + ROUNDER;
            const vfloat away = shift - (shifted - ROUNDER);
            const vint whole = ROUNDED_VINT(shifted) + (parent_centre - half_length + 1 - TAPS / 2);
            for (int lane = 0; lane < WIDTH; lane++)
                first[c + lane] = ((const int *)&whole)[lane];
#endif
            vfloat weight[TAPS], s, co;
            filter_weights(filter, TAPS, away, weight);
#if RAMP
            STORE_LOCAL(turns, phase + c);
            sincos_cycles(WIDTH * LOAD(ramp + chunk + c), &s, &co);
#else
            sincos_cycles(turns, &s, &co);
#endif
#pragma unroll
            for (int t = 0; t < TAPS; t++)
                STORE_LOCAL(weight[t], taps[t] + c);
#if APERTURE_TAPS > 1
            vfloat share[APERTURE_TAPS];
            filter_weights(aperture_filter, APERTURE_TAPS, LOAD(between + chunk + c), share);
#else
            const vfloat share[1] = {1.0f};
#endif
#pragma unroll
            for (int t = 0; t < APERTURE_TAPS; t++)
                STORE_LOCAL(share[t], aperture[t] + c);
            STORE_LOCAL(co, cosine + c);
            STORE_LOCAL(s, sine + c);
        }
        TOGETHER;
        int node = chunk_node;
        for (int block = from + item * BLOCK; block < to; block += items * BLOCK) {
            const int block_end = to - block < BLOCK ? to : block + BLOCK;
            for (int c = 0; c < count; c++) {
                __global const held *line = PARENT_LINE(c);
#ifdef PREFETCH
                const int ahead = c + AHEAD < count ? c + AHEAD : count - 1;
                __global const held *next =
                    PARENT_LINE(ahead) + KEEP(first[ahead] + block, 0, parent_pitch - BLOCK - WIDTH) - block;
#endif
                float weight[TAPS];
#pragma unroll
                for (int t = 0; t < TAPS; t++)
                    weight[t] = taps[t][c];
#if RAMP
                const float step_re = cosine[c], step_im = sine[c];
                vfloat turn_re, turn_im;
                sincos_cycles(phase[c] + ramp[chunk + c] * (LANES + (float)(block - half_length)), &turn_im, &turn_re);
#else
                const float turn_re = cosine[c], turn_im = sine[c];
#endif
                const int start = first[c];
#ifdef SLIDING
                const int before = KEEP(start + block, 0, parent_pitch - TAPS - WIDTH);
                vfloat re_low = LOAD_RE(line, before, parent_pitch), im_low = LOAD_IM(line, before, parent_pitch);
#endif
                for (int k = block; k < block_end; k += WIDTH) {
#ifdef PREFETCH
                    PREFETCH(next + k);
                    PREFETCH(next + k + parent_pitch);
#endif
#ifdef SLIDING
                    const int after = KEEP(start + k + WIDTH, 0, parent_pitch - WIDTH);
                    const vfloat re_high = LOAD_RE(line, after, parent_pitch), im_high = LOAD_IM(line, after, parent_pitch);
                    const vfloat a = filtered(weight, re_low, re_high), b = filtered(weight, im_low, im_high);
                    re_low = re_high;
                    im_low = im_high;
#else
                    const int place = KEEP(start + k, 0, parent_pitch - TAPS - WIDTH);
                    vfloat a = 0.0f, b = 0.0f;
#pragma unroll
                    for (int t = 0; t < TAPS; t++) {
                        a += weight[t] * LOAD_RE(line, place + t, parent_pitch);
                        b += weight[t] * LOAD_IM(line, place + t, parent_pitch);
                    }
#endif
                    aligned_re[(k - block) / WIDTH][c] = a * turn_re - b * turn_im;
                    aligned_im[(k - block) / WIDTH][c] = a * turn_im + b * turn_re;
#if RAMP
                    const vfloat turned = turn_re * step_re - turn_im * step_im;
                    turn_im = turn_re * step_im + turn_im * step_re;
                    turn_re = turned;
#endif
                }
            }
            for (int k = block; k < block_end; k += WIDTH) {
                vfloat re[APERTURE_TAPS], im[APERTURE_TAPS];
                node = chunk_node;
#pragma unroll
                for (int t = 0; t < APERTURE_TAPS; t++) {
                    re[t] = im[t] = 0.0f;
                    if (chunk > begin && HAS(node + t)) {
                        re[t] = LOAD_RE(NODE_LINE(node + t), k, pitch);
                        im[t] = LOAD_IM(NODE_LINE(node + t), k, pitch);
                    }
                }
                for (int c = 0; c < count; c++) {
                    const int channel = chunk + c;
                    for (; node < base[channel]; node++) {
                        /* No later channel reaches this virtual channel. */
                        if (HAS(node)) {
                            STORE_RE(re[0], NODE_LINE(node), k, pitch);
                            STORE_IM(im[0], NODE_LINE(node), k, pitch);
                        }
#pragma unroll
                        for (int t = 0; t + 1 < APERTURE_TAPS; t++) {
                            re[t] = re[t + 1];
                            im[t] = im[t + 1];
                        }
                        re[APERTURE_TAPS - 1] = im[APERTURE_TAPS - 1] = 0.0f;
                    }
                    const vfloat a = aligned_re[(k - block) / WIDTH][c], b = aligned_im[(k - block) / WIDTH][c];
#pragma unroll
                    for (int t = 0; t < APERTURE_TAPS; t++) {
                        re[t] += aperture[t][c] * a;
                        im[t] += aperture[t][c] * b;
                    }
                }
#pragma unroll
                for (int t = 0; t < APERTURE_TAPS; t++)
                    if (HAS(node + t)) {
                        STORE_RE(re[t], NODE_LINE(node + t), k, pitch);
                        STORE_IM(im[t], NODE_LINE(node + t), k, pitch);
                    }
            }
        }
        /* Where this work-item had no samples it passed no channel. */
        chunk_node = max(chunk_node, base[chunk + count - 1]);
    }
    /* Virtual channels beyond the last that any channel reaches. */
    for (int node = end > begin ? max(chunk_node + APERTURE_TAPS, first_node) : first_node; node < end_node; node++)
        for (int k = from + item * WIDTH; k < to; k += items * WIDTH) {
            STORE_RE(0.0f, NODE_LINE(node), k, pitch);
            STORE_IM(0.0f, NODE_LINE(node), k, pitch);
        }
}
