/* A later stage of factorized backprojection for a sheet, whose virtual channels lie in rows beside each other.
 *
 * It does what stage.cl does, with one more dimension. The parent's channels lie in rows too. Each of its rows is a band,
 * whose channels all have the same weights b across the child's rows. So the kernel combines a band's lines along the row
 * first, and then adds the sums to APERTURE_TAPS rows of the child:
 *
 *     for (band = 0; band < band_count; band++) {
 *         sum = combine(lines of the band);               // as in stage.cl, one row of virtual channels
 *         b = aperture_filter(row_position[band.begin]);
 *         for (r = 0; r < APERTURE_TAPS; r++)
 *             child[row(band) + r] += b[r] * sum;
 *     }
 *
 * Build options: as for stage.cl, without SHIFTS_GIVEN and RAMP.
 *
 * row_position   float [roots][channel_pitch]: coordinate of each channel across the sheet, from the middle of the rows
 *                that it adds to, in units of their spacing.
 * The other parameters are those of stages.h, and those of shifts.h without SHIFTS_GIVEN.
 */

#define SHIFTS_GIVEN 0
#define RAMP 0
#include "rows.h"

#define SUMMED_ROWS 1

INLINE float row_weight(const Rows *rows, int row, int c)
{
    return 1.0f;
}

INLINE void put_sum(const Rows *rows, int row, int number, int k, vfloat re, vfloat im)
{
    for (int r = 0; r < APERTURE_TAPS; r++) {
        __global sample_t *line = virtual_line(rows, r, number);
        vfloat sum_re, sum_im;
        load_sample(&sum_re, &sum_im, line, k, rows->pitch);
        store_sample(sum_re + rows->weights[r] * re, sum_im + rows->weights[r] * im, line, k, rows->pitch);
    }
}

#include "combination.h"

__kernel void later_sheet_stage(__global const sample_t *parent_lines, int parent_pitch, __global const Band *bands,
                                int band_count, int first_child, int children_per_root,
                                __global const int *first_virtual, __global const float *tap_position,
                                __global const float *row_position, int channel_pitch, __global const int *parents,
                                int parents_per_root, int lines_per_parent, __global const float *positions,
                                __global const float *offsets, float3 drift, float samples_per_m, float cycles_per_m,
                                int parent_centre, int half_length, __global const float *range_filter,
                                __global const float *aperture_filter, __global const float *phase_polynomials,
                                __global sample_t *child_lines, int child_pitch, int lines_per_child, int length,
                                int part_length, int guard)
{
    __local Chunk chunk;
    const Share share = share_of_item(length, part_length);
    const Filters filters = {range_filter, aperture_filter, phase_polynomials};
    const int child = first_child + get_group_id(0);
    const int row = child / children_per_root * channel_pitch;
    first_virtual += row;
    tap_position += row;
    row_position += row;
    const int root = get_group_id(0) / children_per_root;
    const int parent_number = root * parents_per_root + parents[get_group_id(0) % children_per_root];
    Parent parent = {LINE(parent_lines, parent_number * lines_per_parent, parent_pitch), parent_pitch, 0,
                     positions + 3 * row, channel_pitch, offsets + 6 * child, drift, samples_per_m, cycles_per_m,
                     parent_centre - half_length + 1 - TAPS / 2};

    /* All sums start at 0: those of every virtual channel, if the child uses any. */
    bands += child * band_count;
    const Band all = {.virtual_count = bands[0].virtual_count ? lines_per_child : 0};
    const Rows all_rows = rows_of(&all, child_lines, get_group_id(0), lines_per_child, child_pitch, guard);
    clear_lines(&all_rows, 0, 0, &share);

    /* All bands have the same number of channels. One chunk of each is added after the other, so that the sums of the
     * child's virtual channels about there stay in the cache. */
    for (int skipped = 0; skipped < bands[0].end - bands[0].begin; skipped += CHUNK) {
        for (int number = 0; number < band_count; number++) {
            const Band band = bands[number];
            const int first = band.begin + skipped;
            const int count = band.end - first < CHUNK ? band.end - first : CHUNK;
            vfloat weight[APERTURE_TAPS];
            filter_weights(aperture_filter, APERTURE_TAPS, (vfloat)row_position[band.begin], weight);
            float weights[APERTURE_TAPS];
            for (int r = 0; r < APERTURE_TAPS; r++)
                weights[r] = LANE(weight[r], 0);
            Rows rows = rows_of(&band, child_lines, get_group_id(0), lines_per_child, child_pitch, guard);
            rows.weights = weights;
            rows.written = 0;
            rows.open = rows.open_end = first_virtual[first];
            parent.first_channel = band.parent_channel;
            wait_for_group();
            fill_chunk(&chunk, &parent, first, count, first_virtual, tap_position, &filters, &share);
            wait_for_group();
            add_chunk(&rows, &parent, &chunk, first, count, first_virtual, half_length, phase_polynomials, &share);
        }
    }
}
