/* A stage of factorized backprojection along a curve: fewer lines, of virtual channels, for each child of a subimage.
 *
 * Read one sample and one channel at a time, the kernel does this for a child:
 *
 *     for (m = 0; m < virtual_channels; m++)
 *         for (k = 0; k < length; k++)
 *             child[m][k] = 0;
 *     for (n = begin; n < end; n++) {                     // channels of the parent
 *         line = parent[n];
 *         h = range_filter(nu[n]);                        // TAPS weights
 *         a = aperture_filter(tap_position[n]);           // APERTURE_TAPS weights
 *         for (k = 0; k < length; k++) {
 *             aligned = 0;
 *             for (t = 0; t < TAPS; t++)                  // shift the line by a fraction of a sample,
 *                 aligned += h[t] * line[start[n] + k + t];
 *             phase = cycles[n] + ramp[n] * (k - half_length);
 *             aligned *= exp(2j * pi * phase);            // turn it by the phase of the child's centre,
 *             for (t = 0; t < APERTURE_TAPS; t++)         // and add it to neighbouring virtual channels
 *                 child[first_virtual[n] + t][k] += a[t] * aligned;
 *         }
 *     }
 *
 * or, with a_nm = 0 where channel n does not contribute to virtual channel m,
 *
 *     v_m(k) = sum_n a_nm exp(2j pi (cycles_n + ramp_n (k - half_length))) sum_t h_t(nu_n) s_n(start_n + k + t).
 *
 * So every line is aligned on the child's centre, and the lines are summed with weights that interpolate the aperture. The
 * ramp corrects channels whose ranges grow a little faster or slower across the child than the mean track's.
 *
 * The mean track is one curve, with one band of channels, or several strips, with a band each. first_sheet_stage and
 * later_sheet_stage form the stages of sheets. The headers: stages.h has the tables, shifts.h finds start, nu and cycles,
 * alignment.h aligns lines, and combination.h sums them.
 *
 * Build options: WIDTH (vectors.h; lanes are consecutive samples of a line, or consecutive channels), HALF (samples.h; both
 * for lines in and out), PHASE_TERMS (phases.h), SHIFTS_GIVEN and RAMP (shifts.h), TAPS, APERTURE_TAPS and CHUNK
 * (stages.h).
 */

#include "rows.h"

#define SUMMED_ROWS 1

INLINE float row_weight(const Rows *rows, int row, int c)
{
    return 1.0f;
}

INLINE void put_sum(const Rows *rows, int row, int number, int k, vfloat re, vfloat im)
{
    store_sample(re, im, virtual_line(rows, row, number), k, rows->pitch);
}

#include "combination.h"

__kernel void stage(__global const sample_t *parent_lines, int parent_pitch, __global const Band *bands, int band_count,
                    int first_child, int children_per_root, __global const int *first_virtual,
                    __global const float *tap_position, int channel_pitch,
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
    const Share share = share_of_item(length, part_length);
    const Filters filters = {range_filter, aperture_filter, phase_polynomials};
    const int child = first_child + get_group_id(0);
    const int row = child / children_per_root * channel_pitch;
    first_virtual += row;
    tap_position += row;
#if SHIFTS_GIVEN
    Parent parent = {parent_lines, parent_pitch, 0, order + row, start + row, nu + row, cycles + row};
#if RAMP
    parent.ramp = ramp + row;
#endif
#else
    const int root = get_group_id(0) / children_per_root;
    const int parent_number = root * parents_per_root + parents[get_group_id(0) % children_per_root];
    Parent parent = {LINE(parent_lines, parent_number * lines_per_parent, parent_pitch), parent_pitch, 0,
                     positions + 3 * row, channel_pitch, offsets + 6 * child, drift, samples_per_m, cycles_per_m,
                     parent_centre - half_length + 1 - TAPS / 2};
#endif

    for (int number = 0; number < band_count; number++) {
        const Band band = bands[child * band_count + number];
        Rows rows = rows_of(&band, child_lines, get_group_id(0), lines_per_child, child_pitch, guard);
        rows.written = 0; /* every band has a row of its own */
        parent.first_channel = band.parent_channel;
        for (int first = band.begin; first < band.end; first += CHUNK) {
            const int count = band.end - first < CHUNK ? band.end - first : CHUNK;
            wait_for_group();
            fill_chunk(&chunk, &parent, first, count, first_virtual, tap_position, &filters, &share);
            wait_for_group();
            rows.open_end = rows.open + APERTURE_TAPS;
            add_chunk(&rows, &parent, &chunk, first, count, first_virtual, half_length, phase_polynomials, &share);
            rows.open = max(rows.open, first_virtual[first + count - 1]);
        }
        /* Virtual channels beyond the last that any channel contributes to. */
        clear_lines(&rows, 0, max(rows.open + APERTURE_TAPS, rows.first), &share);
    }
}
