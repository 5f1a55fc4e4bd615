/* Exact backprojection: adds to every pixel x the sum over channels
 *
 *     I(x) += sum_i s_i(rho_i(x)) exp(+j 2 pi cycles_i(x)),
 *
 * with s_i interpolated between samples by TAPS polynomial weights. No absolute range enters: the
 * host refers every (tile, channel) pair, in float64, to the tile's centre, and the kernels only add
 * the difference t in samples between a pixel's range and its tile centre's.
 *
 * Build options
 *   WIDTH      lanes of a work-item (common.h); they form a block of BLOCK_COLUMNS x BLOCK_ROWS
 *              pixels, and a work-item computes four such blocks, one below the other.
 *   TILE_ROWS, TILE_COLUMNS  pixels of a tile, multiples of 4 blocks' rows and of a block's columns.
 *   TAPS       2, 4, 6 or 8 samples per interpolation.
 *   PERMUTE    fetch samples from a window of 2 WIDTH per component held in two registers: five times as fast as a
 *              gather with AVX-512, twice with AVX2. The host asks for it where the samples of all lanes of a block
 *              lie within the window, and the compiler decides whether it can (common.h).
 *   WINDOWS    how many such windows a work-item's four blocks take: 1, 2 (tiles only) or 4.
 *   BISTATIC   receiver positions differ from the transmitter's.
 *   MOVING     receivers move at `velocity` (in units of the sound speed) during the echo's flight.
 *   BEAM       intervals of the table of the channels' weights by aspect angle; 0 is no weights.
 *   ONE_CUBIC  with BEAM: the pixels of a work-item, or the points of a block, lie so close that one cubic of the
 *              weights serves all; 0: those of a block, or each point, have one.
 *   NORMALISE  with BEAM: sum the weights too.
 *   ALONE      these sums are all of the pixels, which are set; 0: they are added to them.
 *   HALF       1: lines are of half in place of float (common.h).
 *   PHASE_TERMS  of the polynomials for sine and cosine of phases.
 *   CENTRED    every line is aligned on its part's centre, at one sample: there are no references. Lines stand
 *              for `shares` others each.
 *
 * Buffers
 *   samples    of `held`, each line with `pitch` samples including its zero margins: WIDTH > 1 a plane
 *              of real parts, then one of imaginary parts, [channels][2][pitch]; WIDTH == 1
 *              interleaved [channels][pitch][2].
 *   geometry   float [18][geometry_pitch]: transmitter x y z and what float32 leaves of them, the
 *              receiver's likewise (m, from the grid's origin), receiver velocity x y z over sound
 *              speed, the track's direction x y z times intervals of `beam` per sine. Rows that no
 *              option uses are absent.
 *   centres    float [parts][6]: of tiles or groups, x y z and what float32 leaves of them (m, from
 *              the grid's origin). With the pairs a short distance between far points is exact.
 *              `expand_tiles` has those of the tiles at work only, `backproject_points` those of all.
 *   ranges     int [parts][3]: the first channel that a tile or group sees, the one after the last,
 *              and the first one's line. What is held per (part, channel) begins with that channel.
 *              The parts at work begin at number first_range.
 *   reference  per (part, channel): nearest sample (int, counted from the line's first margin
 *              sample), the fraction to the tile centre's range (samples) and phase (cycles in
 *              [-0.5, 0.5]), each [parts][channel_pitch].
 *   weights    of the interpolation, [TAPS / 2][2][TAPS / 2] (see interpolate()), then of the polynomials of PHASE_TERMS
 *              terms for sine and cosine, highest power first.
 *   pixels     float2 [rows][columns], whole tiles.
 *   beam       float [BEAM][4]: the weight as cubics of a place in this table, constant terms first,
 *              from 0 to 1 each. A pixel's place is along.e - lowest, with e the unit vector to it
 *              from the middle of transmitter and receiver; beyond low and high the weight is 0.
 *   shares     float [geometry_pitch], with CENTRED and NORMALISE: what the weight of a channel counts.
 *   sums       float2, as pixels: the sum of the weights, twice.
 */

#if WIDTH == 16
#define BLOCK_COLUMNS 4
#define BLOCK_ROWS 4
#define LANE_COLUMNS (vfloat)(-1.5f, -.5f, .5f, 1.5f, -1.5f, -.5f, .5f, 1.5f, -1.5f, -.5f, .5f, 1.5f, -1.5f, -.5f, .5f, 1.5f)
#define LANE_ROWS (vfloat)(-1.5f, -1.5f, -1.5f, -1.5f, -.5f, -.5f, -.5f, -.5f, .5f, .5f, .5f, .5f, 1.5f, 1.5f, 1.5f, 1.5f)
#elif WIDTH == 8
#define BLOCK_COLUMNS 4
#define BLOCK_ROWS 2
#define LANE_COLUMNS (vfloat)(-1.5f, -.5f, .5f, 1.5f, -1.5f, -.5f, .5f, 1.5f)
#define LANE_ROWS (vfloat)(-.5f, -.5f, -.5f, -.5f, .5f, .5f, .5f, .5f)
#elif WIDTH == 4
#define BLOCK_COLUMNS 2
#define BLOCK_ROWS 2
#define LANE_COLUMNS (vfloat)(-.5f, .5f, -.5f, .5f)
#define LANE_ROWS (vfloat)(-.5f, -.5f, .5f, .5f)
#else
#define BLOCK_COLUMNS 1
#define BLOCK_ROWS 1
#define LANE_COLUMNS 0.0f
#define LANE_ROWS 0.0f
#endif
/* A lane in a block's middle, and one in its middle column. */
#define MIDDLE ((BLOCK_ROWS - 1) / 2 * BLOCK_COLUMNS + MIDDLE_COLUMN)
#define MIDDLE_COLUMN ((BLOCK_COLUMNS - 1) / 2)
#define STACK 4
#define ITEM_ROWS (BLOCK_ROWS * STACK)
#define BLOCKS_ACROSS (TILE_COLUMNS / BLOCK_COLUMNS)

/* Middles of what has one cubic of the beam's weights: of a work-item, or its blocks. fabs() of these that is no call
 * (see KEEP). */
#if !ONE_CUBIC
typedef float4 middles;
typedef int4 truths;
#define CUBIC_ROWS BLOCK_ROWS
#define MAGNITUDE(v) as_float4(as_int4(v) & 0x7fffffff)
#define ANY(v) ((v).s0 | (v).s1 | (v).s2 | (v).s3)
#else
typedef float middles;
typedef int truths;
#define CUBIC_ROWS ITEM_ROWS
#define MAGNITUDE(v) as_float(as_int(v) & 0x7fffffff)
#define ANY(v) (v)
#endif

/* Where the samples of a line are taken from: those at `offset` and after, counted from `line`; no number leads out
 * of the line. With WINDOW 2 WIDTH samples in registers, those about a place t as of interpolate(). */
typedef struct {
#ifdef WINDOW
    vfloat re_low, re_high, im_low, im_high;
#else
    __global const held *line;
    int pitch;
#endif
    int offset;
} Source;

#ifdef WINDOW
INLINE Source source(__global const held *line, int pitch, int nearest, float t)
{
    const int whole = ROUNDED_INT(t + ROUNDER);
    __global const held *window = line + KEEP(nearest + whole - (WIDTH - 1), 0, pitch - 2 * WIDTH);
    return (Source){LOAD_HELD(window), LOAD_HELD(window + WIDTH), LOAD_HELD(window + pitch), LOAD_HELD(window + pitch + WIDTH),
                    WIDTH - TAPS / 2 - whole};
}
#else
#define source(line, pitch, nearest, t) ((Source){line, pitch, (nearest) + 1 - TAPS / 2})
#endif

/* Interpolates one line at t + 0.5 samples from sample `nearest`, counted from the line's first margin sample (the 0.5
 * makes rounding find the lower of the two middle taps).
 *
 * The weight of the tap at distance a + 0.5 is E(nu^2) + nu O(nu^2) and its mirror image's
 * E(nu^2) - nu O(nu^2), nu in [-0.5, 0.5] the position between the middle taps; `weights` holds, per
 * pair of taps from the innermost, the coefficients of E then of O, highest power first. */
INLINE void interpolate(const Source *from, vfloat t, __global const float *weights, vfloat *re, vfloat *im)
{
    const vfloat shifted = t + ROUNDER;
    const vfloat nu = t - (shifted - ROUNDER);
    const vfloat nu2 = nu * nu;
#ifndef WINDOW
    const vint index = min(max(ROUNDED_VINT(shifted) + from->offset, (vint)0), (vint)(from->pitch - TAPS));
#if WIDTH == 1
    float2 samples[TAPS];
#pragma unroll
    for (int k = 0; k < TAPS; k++)
        samples[k] = PAIR_HELD(from->line + 2 * (index + k));
#define RE(k) samples[k].x
#define IM(k) samples[k].y
#else
    vfloat re_taps[TAPS], im_taps[TAPS];
#pragma unroll
    for (int lane = 0; lane < WIDTH; lane++) {
        __global const held *sample = from->line + ((const int *)&index)[lane];
#pragma unroll
        for (int k = 0; k < TAPS; k++) {
            ((float *)&re_taps[k])[lane] = ONE_HELD(sample + k);
            ((float *)&im_taps[k])[lane] = ONE_HELD(sample + k + from->pitch);
        }
    }
#define RE(k) re_taps[k]
#define IM(k) im_taps[k]
#endif
#else
    /* The permutation uses an index's lowest bits only: it cannot leave the window. */
    const vint index = AS_VINT(shifted) + from->offset;
#define RE(k) PICK(from->re_low, from->re_high, index + (k))
#define IM(k) PICK(from->im_low, from->im_high, index + (k))
#endif
    vfloat sum_re = 0.0f, sum_im = 0.0f;
#pragma unroll
    for (int pair = 0; pair < TAPS / 2; pair++) {
        __global const float *coefficient = weights + pair * TAPS;
        vfloat even = coefficient[0];
        vfloat odd = coefficient[TAPS / 2];
#pragma unroll
        for (int power = 1; power < TAPS / 2; power++) {
            even = even * nu2 + coefficient[power];
            odd = odd * nu2 + coefficient[TAPS / 2 + power];
        }
        const vfloat upper = odd * nu + even;
        const vfloat lower = even - odd * nu;
        /* One after the other, since a sum of two products is not fused with what it is added to. */
        sum_re += upper * RE(TAPS / 2 + pair);
        sum_re += lower * RE(TAPS / 2 - 1 - pair);
        sum_im += upper * IM(TAPS / 2 + pair);
        sum_im += lower * IM(TAPS / 2 - 1 - pair);
    }
    *re = sum_re;
    *im = sum_im;
#undef RE
#undef IM
}

/* sin and cos of 2 pi t for t in cycles, |t| < 2^22, by polynomials of PHASE_TERMS terms in the square of what is left of
 * a cycle. */
INLINE void turn_of(vfloat t, __global const float *terms, vfloat *sine, vfloat *cosine)
{
    const vfloat nearest = (t + ROUNDER) - ROUNDER;
    const vfloat r = t - nearest;
    const vfloat square = r * r;
    vfloat s = terms[0], c = terms[PHASE_TERMS];
#pragma unroll
    for (int power = 1; power < PHASE_TERMS; power++) {
        s = s * square + terms[power];
        c = c * square + terms[PHASE_TERMS + power];
    }
    *sine = s * r;
    *cosine = c;
}

#if ALONE
#define PUT =
#else
#define PUT +=
#endif

/* Adds a work-item's STACK blocks to the pixels from (row, column) on, or with ALONE sets these to them. */
INLINE void put(const vfloat *re, const vfloat *im, __global float2 *pixels, int columns, int row, int column)
{
#pragma unroll
    for (int block = 0; block < STACK; block++) {
        __global float2 *corner = pixels + (size_t)(row + block * BLOCK_ROWS) * columns + column;
#if WIDTH == 1
        *corner PUT (float2)(re[block], im[block]);
#else
        for (int lane = 0; lane < WIDTH; lane++)
            corner[(size_t)(lane / BLOCK_COLUMNS) * columns + lane % BLOCK_COLUMNS] PUT
                (float2)(((const float *)&re[block])[lane], ((const float *)&im[block])[lane]);
#endif
    }
}

/* Where the centre's echo lies in an entry's line, and its phase. */
#if CENTRED
#define REFERENCE                             \
    const int nearest_sample = centre_sample; \
    const float fraction = 0.0f, turn = 0.0f;
#else
#define REFERENCE                                       \
    const int nearest_sample = reference_sample[entry]; \
    const float fraction = reference_fraction[entry], turn = reference_phase[entry];
#endif

/* Element k of a float4: a constant one, or any. */
#define AT(v, k) ((k) == 0 ? (v).s0 : (k) == 1 ? (v).s1 : (k) == 2 ? (v).s2 : (v).s3)
typedef union {
    float4 all;
    float of[4];
} Four;

#define LANE(v, number) ((const float *)&(v))[number]

#ifdef WINDOW
#define PER_WINDOW (STACK / WINDOWS)
#else
#undef WINDOWS
#define WINDOWS 1
#define PER_WINDOW STACK
#endif

/* What weights are in memory stays there: kept in registers there would be none left, and a product of AVX-512 may take
 * one factor, for all lanes, from memory. With AVX2 they are spilled as vectors, from which a product takes it. */
#if AVX == 512
#define FRESH __asm__ volatile("" : : : "memory")
#else
#define FRESH
#endif

/* Loops over windows and blocks: a GPU keeps what it indexes in registers only where it is unrolled; on a CPU all that
 * is the same for every block would be spilled for every channel. */
#if WIDTH == 1
#define EACH_WINDOW _Pragma("unroll")
#define EACH_BLOCK _Pragma("unroll")
#else
#define EACH_WINDOW _Pragma("unroll 1")
#define EACH_BLOCK _Pragma("unroll 1")
#endif

/* Fixed-point passes for where a moving receiver is when the echo arrives: each gains a factor |b|,
 * 0.003 for a sonar at 5 m/s; the host allows up to 0.05. */
#define PASSES 4

/* Rows of `geometry`. */
#define TX 0
#define RX 6
#define VELOCITY 12
#define ALONG (6 + 6 * BISTATIC + 3 * MOVING)
#define ROW(first, axis) geometry[((first) + (axis)) * geometry_pitch + channel]
#define ROWS(first, axis) LOAD(geometry + ((first) + (axis)) * geometry_pitch + channel)
/* Component of the vector from an antenna to a centre, for one channel and for WIDTH of them. */
#define FROM(first, axis)                                                                          \
    ((centre[axis] - ROW(first, axis)) + (centre[(axis) + 3] - ROW(first, (axis) + 3)))
#define FROMS(first, axis)                                                                         \
    ((centre[axis] - ROWS(first, axis)) + (centre[(axis) + 3] - ROWS(first, (axis) + 3)))

#if BEAM
#define EXPAND_ARGUMENTS , float lowest
#if NORMALISE && CENTRED
#define BEAM_ARGUMENTS \
    , __global const float *beam, float lowest, float low, float high, __global float2 *sums, __global const float *shares
#define SHARE(channel) shares[channel]
#elif NORMALISE
#define BEAM_ARGUMENTS , __global const float *beam, float lowest, float low, float high, __global float2 *sums
#define SHARE(channel) 1.0f
#else
#define BEAM_ARGUMENTS , __global const float *beam, float lowest, float low, float high
#endif

/* The interval at a place in the table, as a float; no number leaves the table. */
#define INTERVAL(type, place, nearest)                                                             \
    type nearest = ((place) - 0.5f + ROUNDER) - ROUNDER;                                           \
    nearest = nearest > 0.0f ? nearest : (type)0.0f;                                               \
    nearest = nearest < BEAM - 1.0f ? nearest : (type)(BEAM - 1.0f);

/* A cubic at x, where the place lies within (low, high); else 0. */
INLINE vfloat beam_weight(vfloat c0, vfloat c1, vfloat c2, vfloat c3, vfloat x, vfloat place, float low, float high)
{
    vfloat weight = c0 + x * (c1 + x * (c2 + x * c3));
    weight = place > low ? weight : (vfloat)0.0f;
    return place < high ? weight : (vfloat)0.0f;
}

/* The weights at places, each with a cubic of its own. */
INLINE vfloat beam_weights(__global const float *beam, vfloat place, float low, float high)
{
    INTERVAL(vfloat, place, nearest)
    const vint interval = ROUNDED_VINT(nearest + ROUNDER);
#if ONE_CUBIC
    const int one = ((const int *)&interval)[MIDDLE];
    __global const float *cubic = beam + 4 * one;
    return beam_weight(cubic[0], cubic[1], cubic[2], cubic[3], place - one, place, low, high);
#else
    vfloat c0, c1, c2, c3;
#pragma unroll
    for (int lane = 0; lane < WIDTH; lane++) {
        __global const float *cubic = beam + 4 * ((const int *)&interval)[lane];
        ((float *)&c0)[lane] = cubic[0];
        ((float *)&c1)[lane] = cubic[1];
        ((float *)&c2)[lane] = cubic[2];
        ((float *)&c3)[lane] = cubic[3];
    }
    return beam_weight(c0, c1, c2, c3, place - nearest, place, low, high);
#endif
}
#else
#define EXPAND_ARGUMENTS
#define BEAM_ARGUMENTS
#endif

/* Expands every channel's range about every tile's centre to third order in pixels (i along columns,
 * j along rows), WIDTH channels per work-item:
 *
 *     t(i, j) = g0 i + g1 j + h0 i^2 + h1 i j + h2 j^2 + k0 i^3 + k1 i^2 j + k2 i j^2 + k3 j^3  [samples]
 *
 * With p the path from transmitter to receiver, e_t and e_r the unit vectors from either to the pixel
 * and b the receiver's velocity over sound speed (0 unless MOVING),
 *
 *     dp   = (e_t + e_r).dx / (1 + e_r.b),
 *     d2p  = (dx'P_t dx / R_t + dy'P_r dy / R_r) / (1 + e_r.b),   dy = dx - b dp,   P = 1 - e e',
 *     d3|D| = -3 (e.dx) (dx'P dx) / R^2, where b is left out: its share is |b| of the smallest term.
 *
 * With BEAM the place along.e - lowest follows, e the unit vector from the antennas' middle: q = along.D/R has
 * a numerator without curvature, so that of the terms X_n of order n in a quotient of Taylor series
 *
 *     q_1 = (along.dx - R_1 q_0)/R_0,   q_2 = -(R_1 q_1 + R_2 q_0)/R_0,   q_3 = -(R_1 q_2 + R_2 q_1 + R_3 q_0)/R_0.
 *
 * Global size (channel_pitch / WIDTH, tiles). step_column, step_row: m per pixel; samples_per_m: samples per metre of range (half a path);
 * drift: samples per column and row that every range gains less.
 * expansion: float [tiles][TERMS][channel_pitch]: g0, g1, h0, h1, h2, k0, k1, k2, k3, then the
 * place and its factors in the same order. */
#if BEAM
#define TERMS 19
#else
#define TERMS 9
#endif

typedef struct {
    vfloat g0, g1, h00, h01, h11, k0, k1, k2, k3;
} Derivatives;

/* First, second and third derivatives of |D| along the steps a (index 0) and b (1); aa, ab, bb: their
 * scalar products. The third ones come as Taylor coefficients (with 1/6 and 1/2). */
INLINE Derivatives distance_derivatives(vfloat x, vfloat y, vfloat z, float4 a, float4 b)
{
    const vfloat inverse = 1.0f / sqrt(x * x + y * y + z * z);
    Derivatives d;
    d.g0 = (x * a.x + y * a.y + z * a.z) * inverse;
    d.g1 = (x * b.x + y * b.y + z * b.z) * inverse;
    d.h00 = (dot(a, a) - d.g0 * d.g0) * inverse;
    d.h01 = (dot(a, b) - d.g0 * d.g1) * inverse;
    d.h11 = (dot(b, b) - d.g1 * d.g1) * inverse;
    const vfloat third = -0.5f * inverse;
    d.k0 = third * d.g0 * d.h00;
    d.k1 = third * (2.0f * d.g0 * d.h01 + d.g1 * d.h00);
    d.k2 = third * (2.0f * d.g1 * d.h01 + d.g0 * d.h11);
    d.k3 = third * d.g1 * d.h11;
    return d;
}

__kernel void expand_tiles(__global const float *geometry, int channel_pitch,
                           int geometry_pitch, __global const int *ranges, int first_range,
                           __global const float *centres, float4 step_column, float4 step_row,
                           float samples_per_m, float2 drift, __global float *expansion EXPAND_ARGUMENTS)
{
    const int entry = get_global_id(0) * WIDTH;
    const int tile = get_global_id(1);
    /* What lies beyond a tile's channels is not used. */
    const int channel = clamp(ranges[3 * (first_range + tile)] + entry, 0, geometry_pitch - WIDTH);
    __global const float *centre = centres + 6 * tile;

    const vfloat tx = FROMS(TX, 0), ty = FROMS(TX, 1), tz = FROMS(TX, 2);
    const Derivatives t = distance_derivatives(tx, ty, tz, step_column, step_row);
#if BISTATIC
    vfloat rx = FROMS(RX, 0), ry = FROMS(RX, 1), rz = FROMS(RX, 2);
#if MOVING
    const vfloat bx = ROWS(VELOCITY, 0), by = ROWS(VELOCITY, 1), bz = ROWS(VELOCITY, 2);
    const vfloat out = sqrt(tx * tx + ty * ty + tz * tz);
    const vfloat ax = rx, ay = ry, az = rz;
    for (int pass = 0; pass < PASSES; pass++) {
        const vfloat path = out + sqrt(rx * rx + ry * ry + rz * rz);
        rx = ax - bx * path;
        ry = ay - by * path;
        rz = az - bz * path;
    }
#endif
    Derivatives r = distance_derivatives(rx, ry, rz, step_column, step_row);
    vfloat g0 = t.g0 + r.g0, g1 = t.g1 + r.g1;
#if MOVING
    const vfloat inverse = 1.0f / sqrt(rx * rx + ry * ry + rz * rz);
    const vfloat closing = 1.0f / (1.0f + (rx * bx + ry * by + rz * bz) * inverse);
    g0 *= closing;
    g1 *= closing;
    /* dy of one pixel step along columns (c) and rows (s), and its part along e_r. */
    const vfloat cx = step_column.x - bx * g0, cy = step_column.y - by * g0, cz = step_column.z - bz * g0;
    const vfloat sx = step_row.x - bx * g1, sy = step_row.y - by * g1, sz = step_row.z - bz * g1;
    const vfloat along_c = (rx * cx + ry * cy + rz * cz) * inverse;
    const vfloat along_s = (rx * sx + ry * sy + rz * sz) * inverse;
    r.h00 = (cx * cx + cy * cy + cz * cz - along_c * along_c) * inverse;
    r.h01 = (cx * sx + cy * sy + cz * sz - along_c * along_s) * inverse;
    r.h11 = (sx * sx + sy * sy + sz * sz - along_s * along_s) * inverse;
    const vfloat scale = 0.5f * samples_per_m * closing;
    g0 *= 0.5f * samples_per_m;
    g1 *= 0.5f * samples_per_m;
#else
    const float scale = 0.5f * samples_per_m;
    g0 *= scale;
    g1 *= scale;
#endif
    const vfloat h00 = t.h00 + r.h00, h01 = t.h01 + r.h01, h11 = t.h11 + r.h11;
    const vfloat k0 = t.k0 + r.k0, k1 = t.k1 + r.k1, k2 = t.k2 + r.k2, k3 = t.k3 + r.k3;
#else
    const float scale = samples_per_m;
    const vfloat g0 = t.g0 * scale, g1 = t.g1 * scale;
    const vfloat h00 = t.h00, h01 = t.h01, h11 = t.h11;
    const vfloat k0 = t.k0, k1 = t.k1, k2 = t.k2, k3 = t.k3;
#endif
    __global float *row = expansion + (size_t)tile * TERMS * channel_pitch + entry;
    STORE(g0 - drift.x, row);
    STORE(g1 - drift.y, row + channel_pitch);
    STORE(h00 * (0.5f * scale), row + 2 * channel_pitch);
    STORE(h01 * scale, row + 3 * channel_pitch);
    STORE(h11 * (0.5f * scale), row + 4 * channel_pitch);
    STORE(k0 * scale, row + 5 * channel_pitch);
    STORE(k1 * scale, row + 6 * channel_pitch);
    STORE(k2 * scale, row + 7 * channel_pitch);
    STORE(k3 * scale, row + 8 * channel_pitch);
#if BEAM
#if BISTATIC
    const vfloat x = 0.5f * (tx + FROMS(RX, 0)), y = 0.5f * (ty + FROMS(RX, 1)), z = 0.5f * (tz + FROMS(RX, 2));
    const Derivatives d = distance_derivatives(x, y, z, step_column, step_row);
#else
    const vfloat x = tx, y = ty, z = tz;
    const Derivatives d = t;
#endif
    const vfloat ux = ROWS(ALONG, 0), uy = ROWS(ALONG, 1), uz = ROWS(ALONG, 2);
    const vfloat near = 1.0f / sqrt(x * x + y * y + z * z);
    const vfloat q = (ux * x + uy * y + uz * z) * near;
    const vfloat q0 = (ux * step_column.x + uy * step_column.y + uz * step_column.z - q * d.g0) * near;
    const vfloat q1 = (ux * step_row.x + uy * step_row.y + uz * step_row.z - q * d.g1) * near;
    STORE(q - lowest, row + 9 * channel_pitch);
    STORE(q0, row + 10 * channel_pitch);
    STORE(q1, row + 11 * channel_pitch);
    const vfloat q00 = (q0 * d.g0 + q * 0.5f * d.h00) * -near;
    const vfloat q01 = (q0 * d.g1 + q1 * d.g0 + q * d.h01) * -near;
    const vfloat q11 = (q1 * d.g1 + q * 0.5f * d.h11) * -near;
    STORE(q00, row + 12 * channel_pitch);
    STORE(q01, row + 13 * channel_pitch);
    STORE(q11, row + 14 * channel_pitch);
    STORE((q00 * d.g0 + q0 * 0.5f * d.h00 + q * d.k0) * -near, row + 15 * channel_pitch);
    STORE((q01 * d.g0 + q00 * d.g1 + q1 * 0.5f * d.h00 + q0 * d.h01 + q * d.k1) * -near, row + 16 * channel_pitch);
    STORE((q11 * d.g0 + q01 * d.g1 + q1 * d.h01 + q0 * 0.5f * d.h11 + q * d.k2) * -near, row + 17 * channel_pitch);
    STORE((q11 * d.g1 + q1 * 0.5f * d.h11 + q * d.k3) * -near, row + 18 * channel_pitch);
#endif
}

/* What expand_tiles has left of a channel, from `term` on: sum_n CUBIC_n(term, i) j^n, with scalars or vectors i and j. */
#define TERM(term, n) (term)[(n) * channel_pitch]
#define CUBIC_0(term, i) ((i) * (TERM(term, 0) + (i) * (TERM(term, 2) + (i) * TERM(term, 5))))
#define CUBIC_1(term, i) (TERM(term, 1) + (i) * (TERM(term, 3) + (i) * TERM(term, 6)))
#define CUBIC_2(term, i) (TERM(term, 4) + (i) * TERM(term, 7))
#define CUBIC_3(term) TERM(term, 8)
#define CUBIC(term, i, j) \
    (CUBIC_0(term, i) + (j) * (CUBIC_1(term, i) + (j) * (CUBIC_2(term, i) + (j) * CUBIC_3(term))))

/* Planar grids: pixels of a tile by the expansion of expand_tiles.
 * Global size (TILE_ROWS TILE_COLUMNS / (4 WIDTH), tiles). Tiles are counted from first_tile, row by row over parts of
 * the image of `down` x `across` tiles each; corners: int [parts][2], a part's first row and column in `pixels`, whose
 * rows hold `columns`. */
__kernel void backproject_tiles(__global const held *samples, int pitch,
#if CENTRED
                                int centre_sample,
#else
                                __global const int *reference_sample,
                                __global const float *reference_fraction,
                                __global const float *reference_phase,
#endif
                                __global const float *expansion, int channel_pitch,
                                __global const int *ranges, int first_range, float cycles_per_sample,
                                __global const float *weights, __global float2 *pixels, int columns,
                                __global const int *corners, int down, int across, int first_tile BEAM_ARGUMENTS)
{
    const int item = get_global_id(0);
    const int tile = get_global_id(1);
    ranges += 3 * (first_range + tile);
    const int begin = ranges[0], end = ranges[1];
#if !ALONE
    if (begin >= end)
        return;
#endif
    const int block_column = item % BLOCKS_ACROSS * BLOCK_COLUMNS;
    const int block_row = item / BLOCKS_ACROSS * ITEM_ROWS;
    const size_t first = (size_t)tile * channel_pitch;
#if !CENTRED
    reference_sample += first;
    reference_fraction += first;
    reference_phase += first;
#endif
    expansion += TERMS * first;
    samples += (size_t)ranges[2] * 2 * pitch;

    /* In pixels from the tile's centre: all lanes, and the middles of the four blocks. */
    const float middle_i = block_column + 0.5f * (BLOCK_COLUMNS - TILE_COLUMNS);
    const float4 middle_j = block_row + 0.5f * (BLOCK_ROWS - TILE_ROWS) + BLOCK_ROWS * (float4)(0.0f, 1.0f, 2.0f, 3.0f);
#if !ONE_CUBIC
    const float4 middle_q = middle_j;
#else
    const float middle_q = block_row + 0.5f * (ITEM_ROWS - TILE_ROWS);
#endif
    const vfloat i = middle_i + LANE_COLUMNS;
    vfloat j[STACK];
#pragma unroll
    for (int block = 0; block < STACK; block++)
        j[block] = AT(middle_j, block) + LANE_ROWS;

    vfloat re[STACK], im[STACK];
#pragma unroll
    for (int block = 0; block < STACK; block++)
        re[block] = im[block] = 0.0f;
#if BEAM && NORMALISE
    vfloat sum[STACK];
#pragma unroll
    for (int block = 0; block < STACK; block++)
        sum[block] = 0.0f;
#endif

    for (int channel = begin; channel < end; channel++) {
        const int entry = channel - begin;
        __global const float *term = expansion + entry;
#if BEAM
        __global const float *of_place = term + 10 * channel_pitch;
        const float q_0 = term[9 * channel_pitch];
        /* The place in the beam and its slopes at the middles of what has one cubic. */
        const middles place = q_0 + CUBIC(of_place, middle_i, middle_q);
        const middles slope_i = (TERM(of_place, 0) + middle_i * (2.0f * TERM(of_place, 2) + middle_i * (3.0f * TERM(of_place, 5))))
            + middle_q * ((TERM(of_place, 3) + middle_i * (2.0f * TERM(of_place, 6))) + middle_q * TERM(of_place, 7));
        const middles slope_j = CUBIC_1(of_place, middle_i)
            + middle_q * (2.0f * CUBIC_2(of_place, middle_i) + middle_q * (3.0f * CUBIC_3(of_place)));
        /* Half a pixel more than the lanes reach leaves room for the curvature. */
        const middles reach = 0.5f * BLOCK_COLUMNS * MAGNITUDE(slope_i) + 0.5f * CUBIC_ROWS * MAGNITUDE(slope_j);
        const truths seen = (place + reach > low) & (place - reach < high);
        if (!ANY(seen))
            continue;
        INTERVAL(middles, place, nearest_place)
#if ONE_CUBIC
        /* About the work-item's middle: slopes, and the one of these that matters. */
        const float nearest = nearest_place;
        const vfloat aside = i - middle_i;
        const vfloat q1 = slope_j
            + aside * (TERM(of_place, 3) + 2.0f * (middle_i * TERM(of_place, 6) + middle_q * TERM(of_place, 7)));
        const vfloat q0 = place + aside * slope_i - middle_q * q1;
#define PLACE(j) (q0 + (j) * q1)
#else
        const vfloat q0 = q_0 + CUBIC_0(of_place, i), q1 = CUBIC_1(of_place, i), q2 = CUBIC_2(of_place, i);
        const float q3 = CUBIC_3(of_place);
#define PLACE(j) (q0 + (j) * (q1 + (j) * (q2 + (j) * q3)))
        const Four nearest_of = {nearest_place};
#endif
#endif
        REFERENCE
        /* Polynomials in j at the lanes' i, less the half sample of interpolate(). */
        const float start = fraction - 0.5f;
        const vfloat t0 = start + CUBIC_0(term, i), t1 = CUBIC_1(term, i), t2 = CUBIC_2(term, i);
        const float t3 = CUBIC_3(term);
        const float cycles = turn - start * cycles_per_sample;
        const float phase = cycles - ((cycles + ROUNDER) - ROUNDER);

        __global const held *line = samples + (size_t)entry * 2 * pitch;
EACH_WINDOW
        for (int window = 0; window < WINDOWS; window++) {
            /* About the middle of its blocks, in a column in their middle. */
            const float row = middle_j.s0 + BLOCK_ROWS * (0.5f * (PER_WINDOW - 1) + window * PER_WINDOW);
            const float at = LANE(t0, MIDDLE_COLUMN)
                + row * (LANE(t1, MIDDLE_COLUMN) + row * (LANE(t2, MIDDLE_COLUMN) + row * t3));
            const Source from = source(line, pitch, nearest_sample, at);
EACH_BLOCK
            for (int block = window * PER_WINDOW; block < (window + 1) * PER_WINDOW; block++) {
                FRESH;
                const vfloat t = t0 + j[block] * (t1 + j[block] * (t2 + j[block] * t3));
                vfloat line_re, line_im, sine, cosine;
                interpolate(&from, t, weights, &line_re, &line_im);
                turn_of(t * cycles_per_sample + phase, weights + TAPS * TAPS / 2, &sine, &cosine);
#if BEAM
#if !ONE_CUBIC
                const float nearest = nearest_of.of[block];
#endif
                __global const float *cubic = beam + 4 * ROUNDED_INT(nearest + ROUNDER);
                const vfloat q = PLACE(j[block]);
                const vfloat weight = beam_weight(cubic[0], cubic[1], cubic[2], cubic[3], q - nearest, q, low, high);
                sine *= weight;
                cosine *= weight;
#if NORMALISE
                sum[block] += SHARE(channel) * weight;
#endif
#endif
                re[block] += line_re * cosine - line_im * sine;
                im[block] += line_re * sine + line_im * cosine;
            }
        }
    }
    corners += (first_tile + tile) / (down * across) * 2;
    const int row = corners[0] + (first_tile + tile) / across % down * TILE_ROWS + block_row;
    const int column = corners[1] + (first_tile + tile) % across * TILE_COLUMNS + block_column;
    put(re, im, pixels, columns, row, column);
#if BEAM && NORMALISE
    put(sum, sum, sums, columns, row, column);
#endif
}

/* Distance |D + d| - |D| without cancellation; 0 where D and d are 0. */
INLINE vfloat distance_change(float x, float y, float z, vfloat dx, vfloat dy, vfloat dz)
{
    const float square = x * x + y * y + z * z;
    const vfloat change = dx * (2.0f * x + dx) + dy * (2.0f * y + dy) + dz * (2.0f * z + dz);
    return change / (sqrt(max(change + square, 0.0f)) + sqrt(square) + FLT_MIN);
}

/* Any pixels: groups of WIDTH * STACK points near a common centre, whose range differences to the centre
 * are computed without cancellation. Global size: groups.
 * offsets: float [3][points], m from the group's centre, from number first_range on as centres and ranges; these and
 * reference_* per group as per tile; drift: as for expand_tiles, per metre; pixels: float2 [groups * WIDTH * STACK]. */
__kernel void backproject_points(__global const held *samples, int pitch,
#if CENTRED
                                 int centre_sample, float4 drift,
#else
                                 __global const int *reference_sample,
                                 __global const float *reference_fraction,
                                 __global const float *reference_phase,
#endif
                                 __global const float *geometry, int geometry_pitch, int channel_pitch,
                                 __global const int *ranges, int first_range, float cycles_per_sample,
                                 __global const float *weights, __global float2 *pixels, int first_group,
                                 __global const float *centres, __global const float *offsets, int points,
                                 float samples_per_m BEAM_ARGUMENTS)
{
    const int group = get_global_id(0);
    ranges += 3 * (first_range + group);
    const int begin = ranges[0], end = ranges[1];
#if !ALONE
    if (begin >= end)
        return;
#endif
#if !CENTRED
    const size_t first = (size_t)group * channel_pitch;
    reference_sample += first;
    reference_fraction += first;
    reference_phase += first;
#endif
    samples += (size_t)ranges[2] * 2 * pitch;
    offsets += (size_t)(first_range + group) * STACK * WIDTH;
    __global const float *centre = centres + 6 * (first_range + group);

    vfloat re[STACK], im[STACK];
#pragma unroll
    for (int block = 0; block < STACK; block++)
        re[block] = im[block] = 0.0f;
#if BEAM && NORMALISE
    vfloat sum[STACK];
#pragma unroll
    for (int block = 0; block < STACK; block++)
        sum[block] = 0.0f;
#endif

    for (int channel = begin; channel < end; channel++) {
        const int entry = channel - begin;
        const float tx = FROM(TX, 0), ty = FROM(TX, 1), tz = FROM(TX, 2);
#if BISTATIC
        float rx = FROM(RX, 0), ry = FROM(RX, 1), rz = FROM(RX, 2);
#if BEAM
        const float px = 0.5f * (tx + rx), py = 0.5f * (ty + ry), pz = 0.5f * (tz + rz);
#endif
#if MOVING
        /* Where the receiver is when the centre's echo arrives. */
        const float bx = ROW(VELOCITY, 0), by = ROW(VELOCITY, 1), bz = ROW(VELOCITY, 2);
        const float ax = rx, ay = ry, az = rz;
        const float out = sqrt(tx * tx + ty * ty + tz * tz);
        for (int pass = 0; pass < PASSES; pass++) {
            const float path = out + sqrt(rx * rx + ry * ry + rz * rz);
            rx = ax - bx * path;
            ry = ay - by * path;
            rz = az - bz * path;
        }
#endif
#elif BEAM
        const float px = tx, py = ty, pz = tz;
#endif
#if BEAM
        const float ux = ROW(ALONG, 0), uy = ROW(ALONG, 1), uz = ROW(ALONG, 2);
#endif
        REFERENCE
        __global const held *line = samples + (size_t)entry * 2 * pitch;
#if WINDOWS == 1
        const Source from = source(line, pitch, nearest_sample, fraction - 0.5f);
#endif
#pragma unroll
        for (int block = 0; block < STACK; block++) {
            const vfloat dx = LOAD(offsets + block * WIDTH);
            const vfloat dy = LOAD(offsets + block * WIDTH + points);
            const vfloat dz = LOAD(offsets + block * WIDTH + 2 * (size_t)points);
#if BEAM
            const vfloat x = px + dx, y = py + dy, z = pz + dz;
            const vfloat q = (ux * x + uy * y + uz * z) / sqrt(x * x + y * y + z * z + FLT_MIN);
            const vfloat weight = beam_weights(beam, q - lowest, low, high);
#if NORMALISE
            sum[block] += SHARE(channel) * weight;
#endif
#endif
            const vfloat out_change = distance_change(tx, ty, tz, dx, dy, dz);
#if MOVING
            vfloat path = out_change + distance_change(rx, ry, rz, dx, dy, dz);
            for (int pass = 0; pass < PASSES; pass++)
                path = out_change
                    + distance_change(rx, ry, rz, dx - bx * path, dy - by * path, dz - bz * path);
#elif BISTATIC
            const vfloat path = out_change + distance_change(rx, ry, rz, dx, dy, dz);
#else
            const vfloat path = 2.0f * out_change;
#endif
#if CENTRED
            const vfloat move = (0.5f * path - (drift.x * dx + drift.y * dy + drift.z * dz)) * samples_per_m;
#else
            const vfloat move = path * (0.5f * samples_per_m);
#endif
            const vfloat t = move + (fraction - 0.5f);
#if WINDOWS > 1
            const Source from = source(line, pitch, nearest_sample, LANE(t, MIDDLE));
#endif
            vfloat line_re, line_im, sine, cosine;
            interpolate(&from, t, weights, &line_re, &line_im);
            turn_of(move * cycles_per_sample + turn, weights + TAPS * TAPS / 2, &sine, &cosine);
#if BEAM
            sine *= weight;
            cosine *= weight;
#endif
            re[block] += line_re * cosine - line_im * sine;
            im[block] += line_re * sine + line_im * cosine;
        }
    }
    put(re, im, pixels, BLOCK_COLUMNS, (first_group + group) * ITEM_ROWS, 0);
#if BEAM && NORMALISE
    put(sum, sum, sums, BLOCK_COLUMNS, (first_group + group) * ITEM_ROWS, 0);
#endif
}
