/* The first stage of factorized backprojection for a sheet, whose virtual channels lie in rows beside each other.
 *
 * It does what stage.cl does, with one more dimension: a channel adds to APERTURE_TAPS consecutive rows, with the weights
 * of the aperture filter across them as well as along them,
 *
 *     for (r = 0; r < APERTURE_TAPS; r++)
 *         for (t = 0; t < APERTURE_TAPS; t++)
 *             child[row(n) + r][first_virtual[n] + t][k] += b[r] * a[t] * aligned;
 *
 * with a for tap_position[n] and b for row_position[n]. Raw channels may be anywhere on the sheet, so every channel has
 * weights b of its own. Channels come in bands, each with those that add to the same rows. A band continues the sums that
 * earlier bands have left in its first rows, and starts the sums of the others.
 *
 * Build options: as for stage.cl, without SHIFTS_GIVEN.
 *
 * row_position   float [roots][channel_pitch]: coordinate of each channel across the sheet, from the middle of the rows
 *                that it adds to, in units of their spacing.
 * The other parameters are those of stages.h, and those of shifts.h with SHIFTS_GIVEN.
 */

#define SHIFTS_GIVEN 1
#include "rows.h"

#define SUMMED_ROWS APERTURE_TAPS

INLINE float row_weight(const Rows *rows, int row, int c)
{
    return rows->channel_weights[row * CHUNK + c];
}

INLINE void put_sum(const Rows *rows, int row, int number, int k, vfloat re, vfloat im)
{
    store_sample(re, im, virtual_line(rows, row, number), k, rows->pitch);
}

#include "combination.h"

__kernel void first_sheet_stage(__global const sample_t *parent_lines, int parent_pitch, __global const Band *bands,
                                int band_count, int first_child, int children_per_root,
                                __global const int *first_virtual, __global const float *tap_position,
                                __global const float *row_position, int channel_pitch, __global const int *order,
                                __global const int *start, __global const float *nu, __global const float *cycles,
#if RAMP
                                __global const float *ramp,
#endif
                                int half_length, __global const float *range_filter,
                                __global const float *aperture_filter, __global const float *phase_polynomials,
                                __global sample_t *child_lines, int child_pitch, int lines_per_child, int length,
                                int part_length, int guard)
{
    __local Chunk chunk;
    __local float channel_weights[APERTURE_TAPS * CHUNK];
    const Share share = share_of_item(length, part_length);
    const Filters filters = {range_filter, aperture_filter, phase_polynomials};
    const int child = first_child + get_group_id(0);
    const int row = child / children_per_root * channel_pitch;
    first_virtual += row;
    tap_position += row;
    row_position += row;
    Parent parent = {parent_lines, parent_pitch, 0, order + row, start + row, nu + row, cycles + row};
#if RAMP
    parent.ramp = ramp + row;
#endif

    for (int number = 0; number < band_count; number++) {
        const Band band = bands[child * band_count + number];
        Rows rows = rows_of(&band, child_lines, get_group_id(0), lines_per_child, child_pitch, guard);
        rows.channel_weights = channel_weights;
        for (int first = band.begin; first < band.end; first += CHUNK) {
            const int count = band.end - first < CHUNK ? band.end - first : CHUNK;
            wait_for_group();
            fill_chunk(&chunk, &parent, first, count, first_virtual, tap_position, &filters, &share);
            for (int c = share.item * WIDTH; c < count; c += share.items * WIDTH) {
                vfloat weight[APERTURE_TAPS];
                filter_weights(aperture_filter, APERTURE_TAPS, LOAD(row_position + first + c), weight);
#pragma unroll
                for (int r = 0; r < APERTURE_TAPS; r++)
                    STORE_LOCAL(weight[r], &channel_weights[r * CHUNK + c]);
            }
            wait_for_group();
            rows.open_end = rows.open + APERTURE_TAPS;
            add_chunk(&rows, &parent, &chunk, first, count, first_virtual, half_length, phase_polynomials, &share);
            rows.open = max(rows.open, first_virtual[first + count - 1]);
        }
        /* Virtual channels beyond the last that any channel contributes to, in rows that no earlier band has set. */
        for (int r = rows.written; r < APERTURE_TAPS; r++)
            clear_lines(&rows, r, max(rows.open + APERTURE_TAPS, rows.first), &share);
    }
}
