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

/* From a virtual channel's line to that in the next row. */
INLINE size_t row_pitch(const Child *child)
{
    return (size_t)(child->end - child->first) * 2 * child->pitch;
}

/* The same in the row `row` rows after. */
INLINE Child row_of(const Child *child, int row)
{
    return (Child){child->lines + row * row_pitch(child), child->pitch, child->first, child->end};
}

#if !RUNNING_SUMS
/* Vectors of a block that are summed together, each weight serving all: their sums and a weight fit 16 registers. */
#define TOGETHER 6

/* Adds a chunk's `count` aligned lines, `vectors` vectors of a block, to samples k on of the virtual channels in row `row` of
 * the band, which earlier chunks and bands have left or not. first_virtual is that of the chunk's channels. Virtual channels
 * before `open` are finished; earlier chunks have added to APERTURE_TAPS from there on. is_new is whether no earlier band
 * has added to the row. With ROWS == 2 sums are added to all rows of the band, with a weight each.
 *
 * Sums are finished one virtual channel after the other, since the channels that contribute to one follow each other. Sums
 * of all that are open at a time would not fit the registers, and branches between few channels are hard to predict. */
INLINE void combine(const ChunkLines *lines, __local const Chunk *chunk, int count, __global const int *first_virtual,
#if ROWS == 2
                    const float *row_weight,
#else
                    int is_new, int row,
#endif
                    const Child *child, int open, int k)
{
    const Aligned *aligned = lines->aligned;
    const int vectors = lines->n, end = min(first_virtual[count - 1] + APERTURE_TAPS, child->end);
    for (int n = 0; n < vectors; n += TOGETHER) {
        int from = 0, to = 0;
        for (int number = max(open, child->first); number < end; number++) {
            __global sample_t *line = virtual_line(child, number) + k + n * WIDTH;
#if ROWS < 2
            const int is_left = number < open + APERTURE_TAPS || !is_new;
#else
            const int is_left = 0;
#endif
            vfloat re[TOGETHER], im[TOGETHER];
#pragma unroll
            for (int m = 0; m < TOGETHER; m++) {
                re[m] = im[m] = 0.0f;
                if (is_left && n + m < vectors) {
                    re[m] = LOAD_RE(line, m * WIDTH, child->pitch);
                    im[m] = LOAD_IM(line, m * WIDTH, child->pitch);
                }
            }
            /* The channels that contribute. */
            while (from < count && first_virtual[from] <= number - APERTURE_TAPS)
                from++;
            while (to < count && first_virtual[to] <= number)
                to++;
            const int first_weight = number * CHUNK;
            for (int c = from; c < to; c++) {
#if ROWS == 1
                const float weight = chunk->row_weight[row][c] * chunk->aperture_weight[first_weight + chunk->weight_of[c]];
#else
                const float weight = chunk->aperture_weight[first_weight + chunk->weight_of[c]];
#endif
#pragma unroll
                for (int m = 0; m < TOGETHER; m++) {
                    re[m] += weight * aligned->re[n + m][c];
                    im[m] += weight * aligned->im[n + m][c];
                }
            }
#if ROWS == 2
            for (int r = 0; r < ACROSS_TAPS; r++, line += row_pitch(child))
                for (int m = 0; m < TOGETHER && n + m < vectors; m++) {
                    const int at = m * WIDTH, pitch = child->pitch;
                    STORE_RE(LOAD_RE(line, at, pitch) + row_weight[r] * re[m], line, at, pitch);
                    STORE_IM(LOAD_IM(line, at, pitch) + row_weight[r] * im[m], line, at, pitch);
                }
#else
#pragma unroll
            for (int m = 0; m < TOGETHER; m++)
                if (n + m < vectors) {
                    STORE_RE(re[m], line, m * WIDTH, child->pitch);
                    STORE_IM(im[m], line, m * WIDTH, child->pitch);
                }
#endif
        }
    }
}
#else
#if ROWS == 2
INLINE void finish_sum(vfloat re, vfloat im, const float *row_weight, const Child *child, int number, int k)
{
    if (!is_of(child, number))
        return;
    __global sample_t *line = virtual_line(child, number);
    for (int r = 0; r < ACROSS_TAPS; r++, line += row_pitch(child)) {
        vfloat left_re, left_im;
        load_sample(&left_re, &left_im, line, k, child->pitch);
        store_sample(left_re + row_weight[r] * re, left_im + row_weight[r] * im, line, k, child->pitch);
    }
}
#define FINISH_SUM(re, im, number) finish_sum(re, im, row_weight, child, number, k)
#else
INLINE void finish_sum(vfloat re, vfloat im, const Child *child, int number, int k)
{
    if (is_of(child, number))
        store_sample(re, im, virtual_line(child, number), k, child->pitch);
}
#define FINISH_SUM(re, im, number) finish_sum(re, im, child, number, k)
#endif

/* The same for WIDTH samples from k on, at which `lines` are those of the chunk. Registers hold the sums of all virtual
 * channels that are open at a time.
 *
 * The sums are two arrays of this function: PoCL took 1.1 times as long with arrays that other functions are given. */
INLINE void combine(const ChunkLines *lines, __local const Chunk *chunk, int count, __global const int *first_virtual,
#if ROWS == 2
                    const float *row_weight,
#else
                    int is_new, int row,
#endif
                    const Child *child, int open, int k)
{
    vfloat re[APERTURE_TAPS], im[APERTURE_TAPS];
    int number = open;
#pragma unroll
    for (int t = 0; t < APERTURE_TAPS; t++) {
        re[t] = im[t] = 0.0f;
        if (ROWS < 2 && is_of(child, number + t))
            load_sample(&re[t], &im[t], virtual_line(child, number + t), k, child->pitch);
    }
    for (int c = 0; c < count; c++) {
        for (; number < first_virtual[c]; number++) {
            /* No later channel contributes to the first of them: another one opens after the last. */
            FINISH_SUM(re[0], im[0], number);
#pragma unroll
            for (int t = 0; t + 1 < APERTURE_TAPS; t++) {
                re[t] = re[t + 1];
                im[t] = im[t + 1];
            }
            re[APERTURE_TAPS - 1] = im[APERTURE_TAPS - 1] = 0.0f;
#if ROWS == 1
            const int opened = number + APERTURE_TAPS;
            if (!is_new && is_of(child, opened))
                load_sample(&re[APERTURE_TAPS - 1], &im[APERTURE_TAPS - 1], virtual_line(child, opened), k, child->pitch);
#endif
        }
        vfloat line_re, line_im;
        aligned_samples(lines, chunk, c, &line_re, &line_im);
#if ROWS == 1
        line_re *= chunk->row_weight[row][c];
        line_im *= chunk->row_weight[row][c];
#endif
#pragma unroll
        for (int t = 0; t < APERTURE_TAPS; t++) {
            re[t] += chunk->aperture_weight[t * CHUNK + c] * line_re;
            im[t] += chunk->aperture_weight[t * CHUNK + c] * line_im;
        }
    }
#pragma unroll
    for (int t = 0; t < APERTURE_TAPS; t++)
        FINISH_SUM(re[t], im[t], number + t);
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
