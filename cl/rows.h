/* The lines that a child's virtual channels have: of one row, or of some rows of a sheet, beside each other. */

#include "stages.h"

/* The rows that the channels of a band add to. Virtual channels are numbered on in all rows of the child; the numbers here
 * are those in the first of these rows. */
typedef struct {
    __global sample_t *lines; /* of the first virtual channel in the first row, from sample 0 on */
    int pitch, first, end;    /* the child has virtual channels `first` to `end` - 1 */
    int open;                 /* earlier channels of the band have finished the sums of virtual channels before it */
    int open_end;             /* and left unfinished sums in those from `open` to before this one */
    int written;              /* leading rows to which earlier bands have added */
    __local const float *channel_weights; /* on sheets, first stage: [APERTURE_TAPS][CHUNK], row by row */
    const float *weights;                 /* on sheets, later stages: [APERTURE_TAPS], of the band for each row */
} Rows;

/* The rows of band `band` of child `number` of those at work; no channel has added to them yet. */
INLINE Rows rows_of(const Band *band, __global sample_t *child_lines, int number, int lines_per_child, int pitch, int guard)
{
    Rows rows = {SAMPLE(LINE(child_lines, number * lines_per_child + band->first_line, pitch), guard), pitch,
                 band->first_virtual, band->first_virtual + band->virtual_count};
    rows.open = rows.open_end = rows.first - APERTURE_TAPS;
    rows.written = band->written_rows;
    return rows;
}

INLINE int has(const Rows *rows, int number)
{
    return number >= rows->first && number < rows->end;
}

/* The line of virtual channel `number` in a row. */
INLINE __global sample_t *virtual_line(const Rows *rows, int row, int number)
{
    return LINE(rows->lines, row * (rows->end - rows->first) + number - rows->first, rows->pitch);
}

/* Sets this work-group's samples of the virtual channels from `number` on to 0. */
INLINE void clear_lines(const Rows *rows, int row, int number, const Share *share)
{
    for (; number < rows->end; number++)
        for (int k = share->from + share->item * WIDTH; k < share->to; k += share->items * WIDTH)
            store_sample(0.0f, 0.0f, virtual_line(rows, row, number), k, rows->pitch);
}
