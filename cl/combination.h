/* Sums of aligned lines in a child's virtual channels, with the weights that interpolate the aperture.
 *
 * A kernel includes rows.h, and then defines what differs between curves and sheets, before it includes this file:
 *   SUMMED_ROWS  rows for which there are sums of their own.
 *   row_weight(rows, row, c)  what channel c of a chunk counts in a row.
 *   put_sum(rows, row, number, k, re, im)  stores WIDTH samples of a sum, finished or not.
 */

#include "alignment.h"

#if RUNNING_SUMS
#define VECTORS_AT_ONCE 1

/* Adds a chunk's `count` aligned lines, vector n of a block, to samples k on of the virtual channels in a row.
 * first_virtual is that of the chunk's channels. Registers hold the sums of all virtual channels that are open at a time.
 *
 * The sums are two arrays of this function: PoCL took 1.1 times as long with arrays that were passed to other functions. */
INLINE void combine_row(const Block *block, int n, int vectors, __local const Chunk *chunk, int count,
                        __global const int *first_virtual, const Rows *rows, int row, int k)
{
    vfloat re[APERTURE_TAPS], im[APERTURE_TAPS];
    const int is_written = row < rows->written;
    int number = rows->open;
#pragma unroll
    for (int t = 0; t < APERTURE_TAPS; t++) {
        re[t] = im[t] = 0.0f;
        if ((number + t < rows->open_end || is_written) && has(rows, number + t))
            load_sample(&re[t], &im[t], virtual_line(rows, row, number + t), k, rows->pitch);
    }
    for (int c = 0; c < count; c++) {
        for (; number < first_virtual[c]; number++) {
            /* No later channel contributes to the first of them: another one opens after the last. */
            if (has(rows, number))
                put_sum(rows, row, number, k, re[0], im[0]);
#pragma unroll
            for (int t = 0; t + 1 < APERTURE_TAPS; t++) {
                re[t] = re[t + 1];
                im[t] = im[t + 1];
            }
            re[APERTURE_TAPS - 1] = im[APERTURE_TAPS - 1] = 0.0f;
            const int opened = number + APERTURE_TAPS;
            if (is_written && has(rows, opened))
                load_sample(&re[APERTURE_TAPS - 1], &im[APERTURE_TAPS - 1], virtual_line(rows, row, opened), k, rows->pitch);
        }
        vfloat line_re, line_im;
        aligned_samples(block, n, c, &line_re, &line_im);
        line_re *= row_weight(rows, row, c);
        line_im *= row_weight(rows, row, c);
#pragma unroll
        for (int t = 0; t < APERTURE_TAPS; t++) {
            re[t] += chunk->aperture_weight[t * CHUNK + c] * line_re;
            im[t] += chunk->aperture_weight[t * CHUNK + c] * line_im;
        }
    }
#pragma unroll
    for (int t = 0; t < APERTURE_TAPS; t++)
        if (has(rows, number + t))
            put_sum(rows, row, number + t, k, re[t], im[t]);
}
#else
/* Vectors that are summed together, so that each weight serves all: their sums and a weight fit 16 registers. */
#define VECTORS_AT_ONCE 6

/* The same for VECTORS_AT_ONCE vectors from number n on, of the `vectors` of a block.
 *
 * Sums are finished one virtual channel after the other, as the channels that contribute to one follow each other. Sums
 * of all that are open at a time would not fit the registers, and branches between few channels are hard to predict. */
INLINE void combine_row(const Block *block, int n, int vectors, __local const Chunk *chunk, int count,
                        __global const int *first_virtual, const Rows *rows, int row, int k)
{
    const int end = min(first_virtual[count - 1] + APERTURE_TAPS, rows->end);
    int from = 0, to = 0;
    for (int number = max(rows->open, rows->first); number < end; number++) {
        __global sample_t *line = virtual_line(rows, row, number);
        const int is_begun = number < rows->open_end || row < rows->written;
        vfloat re[VECTORS_AT_ONCE], im[VECTORS_AT_ONCE];
#pragma unroll
        for (int m = 0; m < VECTORS_AT_ONCE; m++) {
            re[m] = im[m] = 0.0f;
            if (is_begun && n + m < vectors)
                load_sample(&re[m], &im[m], line, k + m * WIDTH, rows->pitch);
        }
        /* The channels that contribute. */
        while (from < count && first_virtual[from] <= number - APERTURE_TAPS)
            from++;
        while (to < count && first_virtual[to] <= number)
            to++;
        const int first_weight = number * CHUNK;
        for (int c = from; c < to; c++) {
            const float weight = row_weight(rows, row, c) * chunk->aperture_weight[first_weight + chunk->weight_of[c]];
#pragma unroll
            for (int m = 0; m < VECTORS_AT_ONCE; m++) {
                re[m] += weight * block->re[n + m][c];
                im[m] += weight * block->im[n + m][c];
            }
        }
#pragma unroll
        for (int m = 0; m < VECTORS_AT_ONCE; m++)
            if (n + m < vectors)
                put_sum(rows, row, number, k + m * WIDTH, re[m], im[m]);
    }
}
#endif

/* Aligns a chunk's `count` lines, from channel `first` on, and adds them to the rows. */
INLINE void add_chunk(const Rows *rows, const Parent *parent, __local const Chunk *chunk, int first, int count,
                      __global const int *first_virtual, int half_length, __global const float *phase_polynomials,
                      const Share *share)
{
    Block block;
    for (int k = share->from + share->item * BLOCK; k < share->to; k += share->items * BLOCK) {
        const int vectors = (share->to - k < BLOCK ? share->to - k : BLOCK) / WIDTH;
        align_block(&block, parent, chunk, first, count, k, vectors, k - half_length, phase_polynomials);
        for (int n = 0; n < vectors; n += VECTORS_AT_ONCE)
            for (int row = 0; row < SUMMED_ROWS; row++)
                combine_row(&block, n, vectors, chunk, count, first_virtual + first, rows, row, k + n * WIDTH);
    }
}
