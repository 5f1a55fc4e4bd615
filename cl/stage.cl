/* A stage of factorized backprojection: from the lines of a parent subimage it forms fewer lines, of virtual channels, for
 * each child,
 *
 *     v_m(k) = sum_n a_nm exp(j 2 pi (cycles_n + ramp_n (k - half_length))) sum_t h_t(nu_n) s_n(start_n + k + t),
 *
 * that is, it aligns every line on the child's centre (a constant shift by a short filter h over contiguous samples, and
 * a phase), and sums lines with weights a that interpolate the aperture. The ramp corrects channels whose ranges grow a
 * little faster or slower across the child than the mean track's. Channels come in the order of the virtual channels they
 * contribute to: channel n adds to APERTURE_TAPS consecutive ones from first_virtual[n] on, so that as many sums are open
 * at a time.
 *
 * Virtual channels may lie in rows, beside each other. Channels then come in bands: those of a band add to the same
 * consecutive rows, and their order is as above within the band. A single mean track is one band and one row.
 *
 * Lines are aligned by alignment.h and summed by combination.h.
 *
 * Build options: WIDTH (vectors.h; lanes are consecutive samples of a line, or consecutive channels), HALF (samples.h, of
 * lines in and out), PHASE_TERMS (phases.h), and
 *   TAPS           of the range filter h, even, at most 8.
 *   APERTURE_TAPS  of the aperture filter a, even; 1: every channel adds to one virtual channel, with weight 1.
 *   ROWS           1: virtual channels lie in rows, and each channel adds to APERTURE_TAPS rows with the weights of a across
 *                  them; 2: so that all channels of a band have equal weights; 0: each channel adds to one row.
 *   SHIFTS_GIVEN   1: shifts and phases come from the host (the first stage, whose channels may be anywhere); 0: they
 *                  follow from the positions of virtual channels.
 *   RAMP           1: phases vary along the lines (only with SHIFTS_GIVEN); 0: every ramp is 0.
 *   CHUNK          channels whose weights are kept at a time, a multiple of WIDTH. Sums that are still open after a chunk
 *                  are written, and read again by the next.
 *
 * parent_lines, parent_pitch  lines of all parents (samples.h).
 * bands          int [roots][children_per_root][band_count][7]: the channels [begin, end) of the band that a child uses; the
 *                channel of the parent's first line; the child's first virtual channel in the band's first row, and how
 *                many the row has; the child's line of that first one; how many of the band's rows, the first ones, earlier
 *                bands have added to. The children at work begin at number first_child, which begins a root.
 * Per root and channel, [roots][channel_pitch]:
 * first_virtual  int: the first virtual channel that the channel contributes to, never decreasing in a band.
 * tap_position   float: aperture coordinate from the middle of the virtual channels it contributes to, in their spacing.
 * row_position   with ROWS, float: the same across the rows that the channel contributes to.
 * order, start, nu, cycles, ramp  with SHIFTS_GIVEN: the channel's line (int), the parent's sample of tap 0 for k = 0
 *                (int), and floats as in the equation; `ramp`, in cycles per sample, with RAMP only.
 * Without SHIFTS_GIVEN:
 * parents        int [children_per_root]: the parent of each child, of parents_per_root; every parent at work has
 *                lines_per_parent lines.
 * positions      float [roots][3][channel_pitch]: of channels, m from the root's centre.
 * offsets        float [roots][children_per_root][6]: the parent's centre from the root's, the child's from the parent's, m.
 * drift          velocity of the receivers over the sound speed: to first order, motion during flight adds
 *                -drift.(x - channel) to the range of x.
 * samples_per_m, cycles_per_m  of range.
 * parent_centre  sample of a parent's line that is at the parent's centre.
 *
 * half_length    samples of a child's line before the one at the child's centre.
 * range_filter, aperture_filter  coefficients of h and a (interpolation.h).
 * phase_polynomials  see phases.h.
 * child_lines, child_pitch  [children at work][lines_per_child] lines (samples.h), of which the kernel writes samples
 *                guard to guard + length - 1; `length` is a multiple of WIDTH.
 *
 * A work-group (of any size along axis 0, of 1 with WIDTH > 1) forms a child's lines, or with several groups along axis 1
 * part_length samples of them, a multiple of 8 WIDTH. No samples outside a parent's line are read: positions move inside,
 * where the host has put zeros.
 */

#include "combination.h"

/* With WIDTH > 1 a work-group is one work-item, which waits for nobody. */
#if WIDTH == 1
#define WAIT_FOR_GROUP barrier(CLK_LOCAL_MEM_FENCE)
#else
#define WAIT_FOR_GROUP
#endif

/* Adds the lines of a chunk from sample k on to those of virtual channels. */
#if ROWS == 2
#define COMBINE(lines, k) \
    combine(lines, &chunk, count, first_virtual + first, row_weight, &child, first_virtual[first], k)
#else
#define COMBINE(lines, k)                                                                                         \
    for (int row = 0; row < ACROSS_TAPS; row++) {                                                                 \
        const Child of_row = row_of(&child, row);                                                                 \
        combine(lines, &chunk, count, first_virtual + first, row >= old_rows, row, &of_row, open, k);             \
    }
#endif

__kernel void stage(__global const sample_t *parent_lines, int parent_pitch, __global const int *bands, int band_count,
                    int first_child, int children_per_root, __global const int *first_virtual,
                    __global const float *tap_position, int channel_pitch,
#if ROWS
                    __global const float *row_position,
#endif
#if SHIFTS_GIVEN
                    __global const int *order, __global const int *start, __global const float *nu,
                    __global const float *cycles,
#if RAMP
                    __global const float *ramp,
#endif
#else
                    __global const int *parents, int parents_per_root, int lines_per_parent,
                    __global const float *positions, __global const float *offsets, float3 drift,
                    float samples_per_m, float cycles_per_m, int parent_centre,
#endif
                    int half_length, __global const float *range_filter, __global const float *aperture_filter,
                    __global const float *phase_polynomials, __global sample_t *child_lines, int child_pitch,
                    int lines_per_child, int length, int part_length, int guard)
{
    __local Chunk chunk;
#if WIDTH > 1
    Aligned aligned;
#endif

    const int item = get_local_id(0), items = get_local_size(0);
    const int from = get_group_id(1) * part_length, to = length - from < part_length ? length : from + part_length;
    const int root = get_group_id(0) / children_per_root;
    const int child_number = first_child + get_group_id(0);
    const int row = (first_child / children_per_root + root) * channel_pitch;
    first_virtual += row;
    tap_position += row;
#if ROWS
    row_position += row;
#endif
#if SHIFTS_GIVEN
    Parent parent = {parent_lines, parent_pitch, order + row};
    start += row;
    nu += row;
    cycles += row;
#if RAMP
    ramp += row;
#endif
#else
    const int parent_number = root * parents_per_root + parents[get_group_id(0) % children_per_root];
    Parent parent = {LINE(parent_lines, parent_number * lines_per_parent, parent_pitch), parent_pitch, 0};
    positions += 3 * row;
    offsets += 6 * child_number;
    const int first_sample = parent_centre - half_length + 1 - TAPS / 2;
#endif

#if ROWS == 2
    /* Bands are as long as each other. All of them are taken up to a channel, so that the sums stay in the cache. */
    __global const int *first_band = bands + 7 * child_number * band_count;
    const Child all = {LINE(child_lines, get_group_id(0) * lines_per_child, child_pitch) + (WIDTH == 1 ? 2 : 1) * guard,
                       child_pitch, 0, first_band[4] ? lines_per_child : 0};
    clear_lines(&all, 0, from, to, item, items);
    for (int step = 0; step < (first_band[1] - first_band[0] + CHUNK - 1) / CHUNK * band_count; step++) {
        const int band = step % band_count, skipped = step / band_count * CHUNK;
#else
    for (int band = 0; band < band_count; band++) {
#endif
        __global const int *of_band = bands + 7 * (child_number * band_count + band);
#if ROWS == 2
        const int begin = of_band[0] + skipped, end = min(of_band[1], begin + CHUNK);
#else
        const int begin = of_band[0], end = of_band[1], old_rows = of_band[6];
#endif
        const Child child = {LINE(child_lines, get_group_id(0) * lines_per_child + of_band[5], child_pitch)
                                 + (WIDTH == 1 ? 2 : 1) * guard,
                             child_pitch, of_band[3], of_band[3] + of_band[4]};
#if !SHIFTS_GIVEN
        parent.first_channel = of_band[2];
#endif
#if ROWS == 2
        vfloat share[ACROSS_TAPS];
        filter_weights(aperture_filter, ACROSS_TAPS, (vfloat)row_position[of_band[0]], share);
        float row_weight[ACROSS_TAPS];
        for (int t = 0; t < ACROSS_TAPS; t++)
            row_weight[t] = LANE(share[t], 0);
#else
        /* The first virtual channel that later channels may contribute to; no channel has contributed yet. */
        int open = child.first - APERTURE_TAPS;
#endif
        for (int first = begin; first < end; first += CHUNK) {
            const int count = end - first < CHUNK ? end - first : CHUNK;
            WAIT_FOR_GROUP;
            for (int c = item * WIDTH; c < count; c += items * WIDTH) {
                const int channel = first + c;
#if SHIFTS_GIVEN
                Shifts shifts;
                for (int lane = 0; lane < WIDTH; lane++)
                    ((int *)&shifts.start)[lane] = start[channel + lane];
                shifts.nu = LOAD(nu + channel);
                shifts.cycles = LOAD(cycles + channel);
#else
                const Shifts shifts = shifts_to_child(positions + channel, channel_pitch, offsets, drift, samples_per_m,
                                                      cycles_per_m, first_sample);
#endif
                store_weights(&chunk, c, shifts, range_filter, aperture_filter, LOAD(tap_position + channel));
#if !RUNNING_SUMS
                for (int lane = 0; lane < WIDTH; lane++)
                    chunk.weight_of[c + lane] = c + lane - CHUNK * first_virtual[channel + lane];
#endif
#if ROWS == 1
                vfloat share[ACROSS_TAPS];
                filter_weights(aperture_filter, ACROSS_TAPS, LOAD(row_position + channel), share);
#pragma unroll
                for (int t = 0; t < ACROSS_TAPS; t++)
                    STORE_LOCAL(share[t], &chunk.row_weight[t][c]);
#endif
                vfloat sine, cosine;
#if RAMP
                STORE_LOCAL(shifts.cycles, &chunk.phase[c]);
                STORE_LOCAL(LOAD(ramp + channel), &chunk.ramp[c]);
                sine_and_cosine(WIDTH * LOAD(ramp + channel), phase_polynomials, &sine, &cosine);
#else
                sine_and_cosine(shifts.cycles, phase_polynomials, &sine, &cosine);
#endif
                STORE_LOCAL(cosine, &chunk.cosine[c]);
                STORE_LOCAL(sine, &chunk.sine[c]);
            }
            WAIT_FOR_GROUP;
#if WIDTH == 1
            for (int k = from + item; k < to; k += items) {
                const ChunkLines lines = {&parent, first, k, k - half_length, phase_polynomials};
                COMBINE(&lines, k);
            }
#else
            for (int block = from; block < to; block += BLOCK) {
                const int vectors = (to - block < BLOCK ? to - block : BLOCK) / WIDTH;
                for (int c = 0; c < count; c++) {
#ifdef PREFETCH
                    const int ahead = c + CHANNELS_AHEAD < count ? c + CHANNELS_AHEAD : count - 1;
                    prefetch_line(line_of(&parent, first + ahead), parent_pitch, chunk.start[ahead] + block, vectors);
#endif
                    const Channel channel = channel_at(&chunk, c, &parent, first + c, block - half_length, phase_polynomials);
                    align_line(&aligned, c, channel, chunk.start[c] + block, vectors);
                }
#if RUNNING_SUMS
                for (int n = 0; n < vectors; n++) {
                    const ChunkLines lines = {&aligned, n};
                    COMBINE(&lines, block + n * WIDTH);
                }
#else
                const ChunkLines lines = {&aligned, vectors};
                COMBINE(&lines, block);
#endif
            }
#endif
#if ROWS < 2
            /* A work-item without samples has passed no channel, so this does not rely on combine(). */
            open = max(open, first_virtual[first + count - 1]);
#endif
        }
#if ROWS < 2
        /* Virtual channels beyond the last that any channel contributes to, and rows without any. */
        const int beyond = max(open + APERTURE_TAPS, child.first);
        for (int r = old_rows; r < ACROSS_TAPS; r++) {
            const Child of_row = row_of(&child, r);
            clear_lines(&of_row, beyond, from, to, item, items);
        }
#endif
    }
}
