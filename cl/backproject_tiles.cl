/* Backprojection onto tiles of a plane grid: adds to every pixel x the sum over channels
 *
 *     I(x) += sum_n w_n(x) s_n(rho_n(x)) exp(+j 2 pi cycles_n(x)),
 *
 * where s_n is interpolated between samples, and expand_tiles has expanded the ranges rho_n about the tile's centre. The
 * same kernel forms exact images and the leaves of factorized ones (ALIGNED).
 *
 * Build options: WIDTH and PERMUTE (vectors.h), HALF (samples.h), TAPS and WINDOWS (lookup.h), PHASE_TERMS (phases.h),
 * BEAM, ONE_CUBIC and NORMALISE (beam.h), OVERWRITE (pixels.h), ALIGNED (parts.h), and
 *   TILE_ROWS, TILE_COLUMNS  pixels of a tile: multiples of ITEM_ROWS and of BLOCK_COLUMNS (pixels.h).
 *
 * lines, line_pitch     see samples.h.
 * ranges, reference_... see parts.h.
 * expansions            see expansions.h.
 * cycles_per_sample     phase per sample of range.
 * filter                see interpolation.h.
 * phase_polynomials     see phases.h.
 * beam_...              see beam.h.
 * represented           float [channels], with NORMALISE and ALIGNED: how many channels each line stands for. Its beam
 *                       weight counts so many times; without ALIGNED every weight counts once.
 * weight_sums           float2, like `pixels`, with NORMALISE: sums of the beam weights, in both parts.
 * pixels                float2 [rows][columns].
 * corners               int [regions][2]: first row and column in `pixels` of regions of tiles_down x tiles_across tiles.
 *                       Tiles are numbered row by row within a region, and region by region, from first_tile on.
 *
 * Global size: (TILE_ROWS TILE_COLUMNS / (STACK WIDTH), tiles).
 */

#include "beam.h"
#include "expansions.h"
#include "parts.h"
#include "pixels.h"

#define BLOCKS_ACROSS (TILE_COLUMNS / BLOCK_COLUMNS)
#define BLOCKS_PER_WINDOW (STACK / WINDOWS)

/* Makes the compiler read weights from memory each time. In registers they would leave no room for anything else, and with
 * AVX-512 a product can take one factor for all lanes from memory. With AVX2 the compiler spills them as vectors, which a
 * product can take from memory. */
#if AVX == 512
#define FORGET_MEMORY __asm__ volatile("" : : : "memory")
#else
#define FORGET_MEMORY
#endif

/* A GPU keeps indexed arrays in registers only where loops are unrolled. On a CPU, unrolled loops would spill everything
 * that is the same for all blocks, again for every channel. */
#if WIDTH == 1
#define EACH_CHANNEL _Pragma("unroll")
#define EACH_WINDOW _Pragma("unroll")
#define EACH_BLOCK _Pragma("unroll")
#else
#define EACH_CHANNEL
#define EACH_WINDOW _Pragma("unroll 1")
#define EACH_BLOCK _Pragma("unroll 1")
#endif

/* Positions of a work-item's pixels, in pixels from the tile's centre. */
typedef struct {
    float middle_i;  /* of the blocks' common middle column */
    float4 middle_j; /* of each block's middle row */
    float4 window_j; /* of the middle row of the blocks that share each window */
    vfloat i;        /* of the lanes */
    vfloat j[STACK];
} Positions;

INLINE Positions positions_of(int block_column, int block_row)
{
    Positions at;
    at.middle_i = block_column + 0.5f * (BLOCK_COLUMNS - TILE_COLUMNS);
    at.middle_j = block_row + 0.5f * (BLOCK_ROWS - TILE_ROWS) + BLOCK_ROWS * (float4)(0.0f, 1.0f, 2.0f, 3.0f);
    at.window_j = at.middle_j.s0
        + BLOCK_ROWS * (0.5f * (BLOCKS_PER_WINDOW - 1) + BLOCKS_PER_WINDOW * (float4)(0.0f, 1.0f, 2.0f, 3.0f));
    at.i = at.middle_i + LANE_COLUMNS;
    at.j[0] = at.middle_j.s0 + LANE_ROWS;
    at.j[1] = at.middle_j.s1 + LANE_ROWS;
    at.j[2] = at.middle_j.s2 + LANE_ROWS;
    at.j[3] = at.middle_j.s3 + LANE_ROWS;
    return at;
}

#if BEAM
/* One value for each cubic of a work-item: one for all blocks, or one per block. */
#if ONE_CUBIC
typedef float per_cubic;
typedef int per_cubic_int;
#define CUBIC_ROWS ITEM_ROWS
#define MAGNITUDE(v) as_float(as_int(v) & 0x7fffffff)
#define ANY(v) (v)
#else
typedef float4 per_cubic;
typedef int4 per_cubic_int;
#define CUBIC_ROWS BLOCK_ROWS
#define MAGNITUDE(v) as_float4(as_int4(v) & 0x7fffffff)
#define ANY(v) ((v).s0 | (v).s1 | (v).s2 | (v).s3)
#endif
DEFINE_INTERVAL_AT(per_cubic, interval_of_cubic)

/* A channel's beam over a work-item's pixels: the table coordinate as a polynomial in j, and the intervals of the cubics. */
typedef struct {
#if ONE_CUBIC
    vfloat c0, c1;
    float interval;
#else
    Polynomial coordinate;
    union {
        float4 all;
        float of[STACK];
    } interval;
#endif
} ItemBeam;

/* Finds a channel's beam over the pixels of a work-item; returns 0 if it covers none of them. `term` points to the table
 * coordinate at the tile's centre. */
INLINE int find_item_beam(__global const float *term, int channel_pitch, const Beam *beam, const Positions *at,
                          ItemBeam *item)
{
    const float centre = term[0], i = at->middle_i;
    const Coefficients c = coefficients_at(term + channel_pitch, channel_pitch);
#if ONE_CUBIC
    const float j = 0.5f * (at->middle_j.s0 + at->middle_j.s3);
#else
    const float4 j = at->middle_j;
#endif
    const per_cubic coordinate = centre + (J_0(c, i) + j * (J_1(c, i) + j * (J_2(c, i) + j * J_3(c))));
    const per_cubic slope_i = J_0_SLOPE(c, i) + j * (J_1_SLOPE(c, i) + j * J_2_SLOPE(c));
    const per_cubic slope_j = J_1(c, i) + j * (2.0f * J_2(c, i) + j * (3.0f * J_3(c)));
    /* Extents are half a pixel larger than those of the lanes, which leaves room for the curvature. */
    const per_cubic extent = 0.5f * BLOCK_COLUMNS * MAGNITUDE(slope_i) + 0.5f * CUBIC_ROWS * MAGNITUDE(slope_j);
    const per_cubic_int covers = (coordinate + extent > beam->low) & (coordinate - extent < beam->high);
    if (!ANY(covers))
        return 0;
#if ONE_CUBIC
    /* Linear about the middle of the work-item's pixels, with the only second derivative that matters. */
    const vfloat aside = at->i - i;
    item->c1 = slope_j + aside * (c.ij + 2.0f * (i * c.iij + j * c.ijj));
    item->c0 = coordinate + aside * slope_i - j * item->c1;
    item->interval = interval_of_cubic(coordinate);
#else
    item->coordinate = polynomial_in_j(centre, c, at->i);
    item->interval.all = interval_of_cubic(coordinate);
#endif
    return 1;
}

/* The weights of the pixels of a block, at rows j. */
INLINE vfloat block_weights(const ItemBeam *item, const Beam *beam, int block, vfloat j)
{
#if ONE_CUBIC
    return weights_in(beam, item->interval, item->c0 + j * item->c1);
#else
    return weights_in(beam, item->interval.of[block], value_at(&item->coordinate, j));
#endif
}
#endif

/* The windows of the blocks. Each lies about the middle of the blocks that share it. */
INLINE Windows item_windows(const Polynomial *position, const Positions *at, int reference, int pitch)
{
    const float c0 = IN_MIDDLE_COLUMN(position->c0), c1 = IN_MIDDLE_COLUMN(position->c1);
    const float c2 = IN_MIDDLE_COLUMN(position->c2);
    const float4 j = at->window_j;
    return windows_about(c0 + j * (c1 + j * (c2 + j * position->c3)), reference, pitch);
}

/* A channel's echoes over a work-item's pixels. */
typedef struct {
    Polynomial position; /* in its line, samples */
    Windows windows;
    __global const sample_t *line;
    float phase; /* cycles, where the position is 0 */
    float channels; /* that the line stands for */
#if BEAM
    ItemBeam beam;
#endif
} ItemChannel;

/* Channels that are prepared before any of them adds its echoes. Preparing a channel is a long chain of operations, which a
 * CPU overlaps with those of other channels only if they follow each other closely. */
#if WIDTH == 1
#define CHANNELS_AT_ONCE 1
#else
#define CHANNELS_AT_ONCE 8
#endif

__kernel void backproject_tiles(__global const sample_t *lines, int line_pitch, __global const int *ranges,
                                int first_range,
#if ALIGNED
                                int centre_sample,
#else
                                __global const int *reference_sample, __global const float *reference_fraction,
                                __global const float *reference_phase,
#endif
                                __global const float *expansions, int channel_pitch, float cycles_per_sample,
                                __global const float *filter, __global const float *phase_polynomials,
#if BEAM
                                __global const float *beam_table, float beam_origin, float beam_low, float beam_high,
#if NORMALISE
#if ALIGNED
                                __global const float *represented,
#endif
                                __global float2 *weight_sums,
#endif
#endif
                                __global float2 *pixels, int columns, __global const int *corners, int tiles_down,
                                int tiles_across, int first_tile)
{
    const int item = get_global_id(0), tile = get_global_id(1);
    const Part part = part_at(ranges, first_range + tile, lines, line_pitch);
#if !OVERWRITE
    if (part.begin >= part.end)
        return;
#endif
    const int block_column = item % BLOCKS_ACROSS * BLOCK_COLUMNS;
    const int block_row = item / BLOCKS_ACROSS * ITEM_ROWS;
    const Positions at = positions_of(block_column, block_row);
    const size_t first_entry = (size_t)tile * channel_pitch;
    expansions += EXPANSION_TERMS * first_entry;
#if BEAM
    const Beam beam = {beam_table, beam_origin, beam_low, beam_high};
#endif

    Sums sums;
    clear_sums(&sums);
    for (int first = part.begin; first < part.end; first += CHANNELS_AT_ONCE) {
        ItemChannel of_item[CHANNELS_AT_ONCE];
        int count = 0;
EACH_CHANNEL
        for (int channel = first; channel < first + CHANNELS_AT_ONCE && channel < part.end; channel++) {
            const int entry = channel - part.begin;
            __global const float *term = expansions + entry;
            ItemChannel *item_channel = &of_item[count];
#if BEAM
            if (!find_item_beam(term + RANGE_TERMS * channel_pitch, channel_pitch, &beam, &at, &item_channel->beam))
                continue;
#endif
#if ALIGNED
            const Reference reference = {centre_sample, 0.0f, 0.0f};
#else
            const size_t pair = first_entry + entry;
            const Reference reference = {reference_sample[pair], reference_fraction[pair], reference_phase[pair]};
#endif
            /* interpolate() expects positions that are half a sample less. */
            const float start = reference.fraction - 0.5f;
            const float cycles = reference.phase - start * cycles_per_sample;
            item_channel->position = polynomial_in_j(start, coefficients_at(term, channel_pitch), at.i);
            item_channel->phase = cycles - ROUNDED(cycles);
#if BEAM && NORMALISE && ALIGNED
            item_channel->channels = represented[channel];
#else
            item_channel->channels = 1.0f;
#endif
            item_channel->line = LINE(part.lines, entry, line_pitch);
            item_channel->windows = item_windows(&item_channel->position, &at, reference.sample, line_pitch);
            count++;
        }
EACH_CHANNEL
        for (int n = 0; n < CHANNELS_AT_ONCE && n < count; n++) {
            const ItemChannel *item_channel = &of_item[n];
EACH_WINDOW
            for (int window = 0; window < WINDOWS; window++) {
                const Lookup lookup = lookup_in(&item_channel->windows, window, item_channel->line, line_pitch);
EACH_BLOCK
                for (int block = window * BLOCKS_PER_WINDOW; block < (window + 1) * BLOCKS_PER_WINDOW; block++) {
                    FORGET_MEMORY;
                    const vfloat t = value_at(&item_channel->position, at.j[block]);
#if BEAM
                    const vfloat weight = block_weights(&item_channel->beam, &beam, block, at.j[block]);
#else
                    const vfloat weight = 1.0f;
#endif
                    add_echoes(&sums, block, &lookup, t, filter, t * cycles_per_sample + item_channel->phase,
                               phase_polynomials, weight, item_channel->channels);
                }
            }
        }
    }

    const int number = first_tile + tile;
    __global const int *corner = corners + number / (tiles_down * tiles_across) * 2;
    const int row = corner[0] + number / tiles_across % tiles_down * TILE_ROWS + block_row;
    const int column = corner[1] + number % tiles_across * TILE_COLUMNS + block_column;
    put_blocks(sums.re, sums.im, pixels, columns, row, column);
#if BEAM && NORMALISE
    put_blocks(sums.weight, sums.weight, weight_sums, columns, row, column);
#endif
}
