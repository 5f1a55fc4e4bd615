/* What the kernels of all stages share: their tables, and the share of the work that a work-group does.
 *
 * Channels come in bands. Those of a band are in the order of the virtual channels that they contribute to: channel n
 * adds to APERTURE_TAPS consecutive ones from first_virtual[n] on. So only few sums are open at a time.
 *
 * Build options
 *   TAPS           of the range filter h, even, at most 8.
 *   APERTURE_TAPS  of the aperture filter a, even; 1: every channel adds to one virtual channel, with weight 1.
 *   CHUNK          channels whose weights are kept at a time, a multiple of WIDTH. Sums that are still open after a chunk
 *                  are stored, and continued by the next.
 *
 * Kernel parameters:
 * parent_lines, parent_pitch  lines of all parents (samples.h).
 * bands          [roots][children_per_root][band_count] of Band. The children at work begin at number first_child, which
 *                begins a root.
 * first_virtual  int [roots][channel_pitch]: the first virtual channel that each channel contributes to, which never
 *                decreases within a band.
 * tap_position   float [roots][channel_pitch]: aperture coordinate of each channel, from the middle of the virtual channels
 *                it contributes to, in units of their spacing.
 * half_length    samples of a child's line before the one at the child's centre.
 * range_filter, aperture_filter  coefficients of h and a (interpolation.h).
 * phase_polynomials  see phases.h.
 * child_lines, child_pitch  [children at work][lines_per_child] lines (samples.h). The kernel writes samples guard to
 *                guard + length - 1; `length` is a multiple of WIDTH.
 *
 * A work-group (of any size along axis 0, of 1 with WIDTH > 1) forms a child's lines. With several groups along axis 1,
 * each forms part_length samples of them, a multiple of 8 WIDTH. No samples outside a parent's line are read: positions
 * are moved inside, where the host has put zeros.
 */

#include "samples.h"

/* A row of the table `bands`: the channels of a band that a child uses, and where it adds them. */
typedef struct {
    int begin, end;     /* the channels: the first, and the one after the last */
    int parent_channel; /* the channel of the parent's first line */
    int first_virtual;  /* the child's first virtual channel in the band's first row */
    int virtual_count;  /* its virtual channels in each row */
    int first_line;     /* the child's line of virtual channel first_virtual */
    int written_rows;   /* leading rows of the band that earlier bands have added to */
} Band;

/* Coefficients of the filters, and of the polynomials for phases. */
typedef struct {
    __global const float *range, *aperture, *phases;
} Filters;

/* The share of a work-item: samples `from` to `to` - 1, which it divides with the other `items` of its group. */
typedef struct {
    int from, to, item, items;
} Share;

INLINE Share share_of_item(int length, int part_length)
{
    const int from = get_group_id(1) * part_length;
    return (Share){from, length - from < part_length ? length : from + part_length, get_local_id(0), get_local_size(0)};
}

/* Waits until the work-items of a group have all come here. With WIDTH > 1 there is only one. */
INLINE void wait_for_group(void)
{
    if (WIDTH == 1)
        barrier(CLK_LOCAL_MEM_FENCE);
}
