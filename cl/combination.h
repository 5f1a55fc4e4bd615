/* Sums of aligned lines in a child's virtual channels, with the weights that interpolate the aperture.
 *
 * For the stage kernel; its build options are told in stage.cl.
 */

#include "alignment.h"

/* A child's virtual channels, from `first` to `end` - 1, and their lines without the guard. */
typedef struct {
    __global sample_t *lines;
    int pitch, first, end;
} Child;

INLINE int is_of(const Child *child, int number)
{
    return number >= child->first && number < child->end;
}

INLINE __global sample_t *virtual_line(const Child *child, int number)
{
    return LINE(child->lines, number - child->first, child->pitch);
}

/* The same in the row `row` rows after. */
INLINE Child row_of(const Child *child, int row)
{
    const int lines = row * (child->end - child->first);
    return (Child){child->lines + (long)lines * 2 * child->pitch, child->pitch, child->first, child->end};
}

INLINE void store_sum(vfloat re, vfloat im, const Child *child, int number, int k)
{
    if (is_of(child, number)) {
        STORE_RE(re, virtual_line(child, number), k, child->pitch);
        STORE_IM(im, virtual_line(child, number), k, child->pitch);
    }
}

#if ROWS == 2
/* Adds a sum along the band to virtual channel `number` of every row, with the row's weight. */
INLINE void add_to_rows(vfloat re, vfloat im, const float *row_weight, const Child *child, int number, int k)
{
    if (!is_of(child, number))
        return;
    __global sample_t *line = virtual_line(child, number);
    const size_t row_pitch = (size_t)(child->end - child->first) * 2 * child->pitch;
#pragma unroll
    for (int r = 0; r < ACROSS_TAPS; r++, line += row_pitch) {
        STORE_RE(LOAD_RE(line, k, child->pitch) + row_weight[r] * re, line, k, child->pitch);
        STORE_IM(LOAD_IM(line, k, child->pitch) + row_weight[r] * im, line, k, child->pitch);
    }
}

/* As combine() below, where a chunk's channels have equal weights across the rows: sums along the band are finished first.
 * The lines of the rows hold what was added to them before. */
INLINE void combine_in_rows(const Aligned *aligned, int n, __local const Chunk *chunk, int count,
                            __global const int *first_virtual, const float *row_weight, const Child *child, int k)
{
    vfloat re[APERTURE_TAPS], im[APERTURE_TAPS];
#pragma unroll
    for (int t = 0; t < APERTURE_TAPS; t++)
        re[t] = im[t] = 0.0f;
    int number = first_virtual[0];
    for (int c = 0; c < count; c++) {
        for (; number < first_virtual[c]; number++) {
            add_to_rows(re[0], im[0], row_weight, child, number, k);
#pragma unroll
            for (int t = 0; t + 1 < APERTURE_TAPS; t++) {
                re[t] = re[t + 1];
                im[t] = im[t + 1];
            }
            re[APERTURE_TAPS - 1] = im[APERTURE_TAPS - 1] = 0.0f;
        }
        const vfloat line_re = aligned->re[n][c], line_im = aligned->im[n][c];
#pragma unroll
        for (int t = 0; t < APERTURE_TAPS; t++) {
            re[t] += chunk->aperture_weight[t][c] * line_re;
            im[t] += chunk->aperture_weight[t][c] * line_im;
        }
    }
#pragma unroll
    for (int t = 0; t < APERTURE_TAPS; t++)
        add_to_rows(re[t], im[t], row_weight, child, number + t, k);
}
#else
/* Adds a chunk's `count` aligned lines, vector `n` of their block, to samples k on of the virtual channels from `number`
 * on, in row `row` of the band. first_virtual is that of the chunk's channels; is_new is whether no earlier band has added
 * to the row.
 *
 * The sums of the APERTURE_TAPS virtual channels that are open are two arrays of this function: with a structure of arrays
 * the stage took 1.4 times as long on Intel's runtime, and 1.1 times on PoCL with arrays that other functions are given. */
INLINE void combine(const Aligned *aligned, int n, __local const Chunk *chunk, int count,
                    __global const int *first_virtual, int is_first_chunk, int is_new, int row, const Child *child,
                    int number, int k)
{
    vfloat re[APERTURE_TAPS], im[APERTURE_TAPS];
    /* Earlier chunks have left the sums that are open. */
#pragma unroll
    for (int t = 0; t < APERTURE_TAPS; t++) {
        re[t] = im[t] = 0.0f;
        if (!(is_first_chunk && is_new) && is_of(child, number + t)) {
            re[t] = LOAD_RE(virtual_line(child, number + t), k, child->pitch);
            im[t] = LOAD_IM(virtual_line(child, number + t), k, child->pitch);
        }
    }
    for (int c = 0; c < count; c++) {
        for (; number < first_virtual[c]; number++) {
            /* No later channel contributes to the first of them: another one opens after the last. */
            store_sum(re[0], im[0], child, number, k);
#pragma unroll
            for (int t = 0; t + 1 < APERTURE_TAPS; t++) {
                re[t] = re[t + 1];
                im[t] = im[t + 1];
            }
            re[APERTURE_TAPS - 1] = im[APERTURE_TAPS - 1] = 0.0f;
#if ROWS == 1
            const int opened = number + APERTURE_TAPS;
            if (!is_new && is_of(child, opened)) {
                re[APERTURE_TAPS - 1] = LOAD_RE(virtual_line(child, opened), k, child->pitch);
                im[APERTURE_TAPS - 1] = LOAD_IM(virtual_line(child, opened), k, child->pitch);
            }
#endif
        }
#if ROWS == 1
        const vfloat line_re = chunk->row_weight[row][c] * aligned->re[n][c];
        const vfloat line_im = chunk->row_weight[row][c] * aligned->im[n][c];
#else
        const vfloat line_re = aligned->re[n][c], line_im = aligned->im[n][c];
#endif
#pragma unroll
        for (int t = 0; t < APERTURE_TAPS; t++) {
            re[t] += chunk->aperture_weight[t][c] * line_re;
            im[t] += chunk->aperture_weight[t][c] * line_im;
        }
    }
#pragma unroll
    for (int t = 0; t < APERTURE_TAPS; t++)
        store_sum(re[t], im[t], child, number + t, k);
}
#endif

/* Sets samples `from` on, to `to`, of the virtual channels from `number` on to 0. */
INLINE void clear_lines(const Child *child, int number, int from, int to, int item, int items)
{
    for (; number < child->end; number++)
        for (int k = from + item * WIDTH; k < to; k += items * WIDTH) {
            STORE_RE(0.0f, virtual_line(child, number), k, child->pitch);
            STORE_IM(0.0f, virtual_line(child, number), k, child->pitch);
        }
}
