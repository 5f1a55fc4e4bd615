/* The pixels of a work-item, and their sums over channels.
 *
 * The lanes of a vector are the pixels of a block, BLOCK_COLUMNS x BLOCK_ROWS of them. A work-item computes STACK blocks, one
 * below the other.
 *
 * Build options
 *   OVERWRITE  1: sums replace the pixels; 0: they are added to the pixels.
 *   BEAM, NORMALISE  as in beam.h; with both, weights are summed as well as echoes.
 */

#include "lookup.h"
#include "phases.h"

/* LANE_COLUMNS and LANE_ROWS: positions of the lanes from their block's centre, pixels. */
#define BLOCK_COLUMNS JOIN(BLOCK_COLUMNS_, WIDTH)
#define BLOCK_ROWS JOIN(BLOCK_ROWS_, WIDTH)
#define LANE_COLUMNS ((vfloat)JOIN(LANE_COLUMNS_, WIDTH))
#define LANE_ROWS ((vfloat)JOIN(LANE_ROWS_, WIDTH))
#define BLOCK_COLUMNS_1 1
#define BLOCK_ROWS_1 1
#define LANE_COLUMNS_1 (0.0f)
#define LANE_ROWS_1 (0.0f)
#define BLOCK_COLUMNS_4 2
#define BLOCK_ROWS_4 2
#define LANE_COLUMNS_4 (-.5f, .5f, -.5f, .5f)
#define LANE_ROWS_4 (-.5f, -.5f, .5f, .5f)
#define BLOCK_COLUMNS_8 4
#define BLOCK_ROWS_8 2
#define LANE_COLUMNS_8 (-1.5f, -.5f, .5f, 1.5f, -1.5f, -.5f, .5f, 1.5f)
#define LANE_ROWS_8 (-.5f, -.5f, -.5f, -.5f, .5f, .5f, .5f, .5f)
#define BLOCK_COLUMNS_16 4
#define BLOCK_ROWS_16 4
#define LANE_COLUMNS_16 (-1.5f, -.5f, .5f, 1.5f, -1.5f, -.5f, .5f, 1.5f, -1.5f, -.5f, .5f, 1.5f, -1.5f, -.5f, .5f, 1.5f)
#define LANE_ROWS_16 (-1.5f, -1.5f, -1.5f, -1.5f, -.5f, -.5f, -.5f, -.5f, .5f, .5f, .5f, .5f, 1.5f, 1.5f, 1.5f, 1.5f)
#define STACK 4
#define ITEM_ROWS (BLOCK_ROWS * STACK)

/* A lane in a block's middle column, and one in its middle. */
#define MIDDLE_COLUMN ((BLOCK_COLUMNS - 1) / 2)
#define IN_MIDDLE_COLUMN(vector) (0.5f * (LANE(vector, MIDDLE_COLUMN) + LANE(vector, BLOCK_COLUMNS / 2)))
#define MIDDLE ((BLOCK_ROWS - 1) / 2 * BLOCK_COLUMNS + MIDDLE_COLUMN)

/* Sums over channels, block by block. */
typedef struct {
    vfloat re[STACK], im[STACK];
#if BEAM && NORMALISE
    vfloat weight[STACK];
#endif
} Sums;

INLINE void clear_sums(Sums *sums)
{
#pragma unroll
    for (int block = 0; block < STACK; block++) {
        sums->re[block] = sums->im[block] = 0.0f;
#if BEAM && NORMALISE
        sums->weight[block] = 0.0f;
#endif
    }
}

/* Adds the echoes of one channel to a block: its line at t + 0.5 samples from the lookup's reference sample, rotated by
 * `cycles`. With BEAM the echoes are weighted, and `channels` times each weight is added to the sums of weights. */
INLINE void add_echoes(Sums *sums, int block, const Lookup *lookup, vfloat t, __global const float *filter, vfloat cycles,
                       __global const float *phase_polynomials, vfloat weight, float channels)
{
    vfloat re, im, sine, cosine;
    interpolate(lookup, t, filter, &re, &im);
    sine_and_cosine(cycles, phase_polynomials, &sine, &cosine);
#if BEAM
    sine *= weight;
    cosine *= weight;
#if NORMALISE
    sums->weight[block] += channels * weight;
#endif
#endif
    sums->re[block] += re * cosine - im * sine;
    sums->im[block] += re * sine + im * cosine;
}

#if OVERWRITE
#define PUT =
#else
#define PUT +=
#endif

/* Puts a work-item's blocks into the pixels from (row, column) on of an image with `columns` columns. */
INLINE void put_blocks(const vfloat *re, const vfloat *im, __global float2 *pixels, int columns, int row, int column)
{
#pragma unroll
    for (int block = 0; block < STACK; block++) {
        __global float2 *corner = pixels + (size_t)(row + block * BLOCK_ROWS) * columns + column;
#if WIDTH == 1
        *corner PUT (float2)(re[block], im[block]);
#else
        for (int lane = 0; lane < WIDTH; lane++)
            corner[(size_t)(lane / BLOCK_COLUMNS) * columns + lane % BLOCK_COLUMNS] PUT
                (float2)(LANE(re[block], lane), LANE(im[block], lane));
#endif
    }
}
