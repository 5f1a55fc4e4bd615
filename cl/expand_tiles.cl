/* Expands the range from every channel about every tile's centre, to third order in pixels: i along columns, j along
 * rows, from the centre. backproject_tiles evaluates the expansions.
 *
 *     t(i, j) = c_i i + c_j j + c_ii i^2 + c_ij i j + c_jj j^2 + c_iii i^3 + c_iij i^2 j + c_ijj i j^2 + c_jjj j^3
 *
 * in samples. Let p be the path from transmitter to receiver, e_t and e_r the unit vectors from them to the pixel, R_t and
 * R_r the distances, and b the receiver's velocity over the sound speed (0 unless MOVING). Then
 *
 *     dp   = (e_t + e_r).dx / (1 + e_r.b),
 *     d2p  = (dx'P_t dx / R_t + dy'P_r dy / R_r) / (1 + e_r.b),   dy = dx - b dp,   P = 1 - e e',
 *     d3|D| = -3 (e.dx) (dx'P dx) / R^2, without b, which would change this smallest term by a fraction |b| only.
 *
 * With BEAM the expansion of the beam's table coordinate (beam.h) follows, q = along.D / R - beam_origin. Its numerator is
 * linear. With X_n for the terms of order n of a function X, a quotient of Taylor series therefore has
 *
 *     q_1 = (along.dx - R_1 q_0)/R_0,   q_2 = -(R_1 q_1 + R_2 q_0)/R_0,   q_3 = -(R_1 q_2 + R_2 q_1 + R_3 q_0)/R_0.
 *
 * Build options: WIDTH (vectors.h), BISTATIC, MOVING and BEAM (antennas.h).
 *
 * geometry, centres  see antennas.h; `centres` holds only the tiles at work.
 * ranges             see parts.h. A work-item expands WIDTH channels of a tile.
 * column_step, row_step  m per pixel.
 * samples_per_m      samples per metre of range, which is half a path.
 * drift              samples by which every range becomes shorter because receivers move, per column and per row.
 * beam_origin        see beam.h.
 * expansions         float [tiles][EXPANSION_TERMS][channel_pitch], in the order of expansions.h.
 *
 * Global size: (channel_pitch / WIDTH, tiles).
 */

#define CHANNEL_VALUES(p) LOAD(p)
#include "antennas.h"
#include "expansions.h"

/* Taylor coefficients of a function of pixels, without the constant term. */
typedef struct {
    vfloat i, j, ii, ij, jj, iii, iij, ijj, jjj;
} Taylor;

/* |D + i column_step + j row_step| */
INLINE Taylor distance_expansion(Vector D, Vector column_step, Vector row_step)
{
    const vfloat inverse = 1.0f / magnitude(D);
    Taylor d;
    d.i = scalar_product(D, column_step) * inverse;
    d.j = scalar_product(D, row_step) * inverse;
    d.ii = 0.5f * (scalar_product(column_step, column_step) - d.i * d.i) * inverse;
    d.ij = (scalar_product(column_step, row_step) - d.i * d.j) * inverse;
    d.jj = 0.5f * (scalar_product(row_step, row_step) - d.j * d.j) * inverse;
    d.iii = -inverse * d.i * d.ii;
    d.iij = -inverse * (d.i * d.ij + d.j * d.ii);
    d.ijj = -inverse * (d.j * d.ij + d.i * d.jj);
    d.jjj = -inverse * d.j * d.jj;
    return d;
}

INLINE Taylor sum_of_expansions(Taylor a, Taylor b)
{
    return (Taylor){a.i + b.i,     a.j + b.j,     a.ii + b.ii,   a.ij + b.ij,  a.jj + b.jj,
                    a.iii + b.iii, a.iij + b.iij, a.ijj + b.ijj, a.jjj + b.jjj};
}

INLINE Taylor scaled_expansion(Taylor a, vfloat factor)
{
    return (Taylor){a.i * factor,   a.j * factor,   a.ii * factor,  a.ij * factor, a.jj * factor,
                    a.iii * factor, a.iij * factor, a.ijj * factor, a.jjj * factor};
}

/* Expansion of the path to a receiver that moves, from the expansions of the distances to the transmitter and to the
 * receiver at the time of arrival. D leads from the latter to the centre. */
INLINE Taylor moving_path_expansion(Taylor out, Taylor back, Vector D, Vector velocity, Vector column_step,
                                    Vector row_step)
{
    const vfloat inverse = 1.0f / magnitude(D);
    const vfloat closing = 1.0f / (1.0f + scalar_product(D, velocity) * inverse);
    /* dy of one step along columns and along rows, and its component along e_r. */
    const Vector dy_column = sum_of(column_step, -(out.i + back.i) * closing, velocity);
    const Vector dy_row = sum_of(row_step, -(out.j + back.j) * closing, velocity);
    const vfloat along_column = scalar_product(D, dy_column) * inverse;
    const vfloat along_row = scalar_product(D, dy_row) * inverse;
    back.ii = 0.5f * (scalar_product(dy_column, dy_column) - along_column * along_column) * inverse;
    back.ij = (scalar_product(dy_column, dy_row) - along_column * along_row) * inverse;
    back.jj = 0.5f * (scalar_product(dy_row, dy_row) - along_row * along_row) * inverse;
    return scaled_expansion(sum_of_expansions(out, back), closing);
}

/* Expansion of along.D / |D|. `value` becomes its value at the centre; R is the expansion of |D|. */
INLINE Taylor aspect_expansion(Vector D, Vector along, Taylor R, vfloat *value, Vector column_step, Vector row_step)
{
    const vfloat inverse = 1.0f / magnitude(D);
    const vfloat centre = scalar_product(along, D) * inverse;
    Taylor q;
    q.i = (scalar_product(along, column_step) - centre * R.i) * inverse;
    q.j = (scalar_product(along, row_step) - centre * R.j) * inverse;
    q.ii = (q.i * R.i + centre * R.ii) * -inverse;
    q.ij = (q.i * R.j + q.j * R.i + centre * R.ij) * -inverse;
    q.jj = (q.j * R.j + centre * R.jj) * -inverse;
    q.iii = (q.ii * R.i + q.i * R.ii + centre * R.iii) * -inverse;
    q.iij = (q.ij * R.i + q.ii * R.j + q.j * R.ii + q.i * R.ij + centre * R.iij) * -inverse;
    q.ijj = (q.jj * R.i + q.ij * R.j + q.j * R.ij + q.i * R.jj + centre * R.ijj) * -inverse;
    q.jjj = (q.jj * R.j + q.j * R.jj + centre * R.jjj) * -inverse;
    *value = centre;
    return q;
}

INLINE void store_expansion(Taylor a, __global float *row, int channel_pitch)
{
    STORE(a.i, row);
    STORE(a.j, row + channel_pitch);
    STORE(a.ii, row + 2 * channel_pitch);
    STORE(a.ij, row + 3 * channel_pitch);
    STORE(a.jj, row + 4 * channel_pitch);
    STORE(a.iii, row + 5 * channel_pitch);
    STORE(a.iij, row + 6 * channel_pitch);
    STORE(a.ijj, row + 7 * channel_pitch);
    STORE(a.jjj, row + 8 * channel_pitch);
}

__kernel void expand_tiles(__global const float *geometry, int geometry_pitch, __global const float *centres,
                           __global const int *ranges, int first_range, float3 column_step, float3 row_step,
                           float samples_per_m, float2 drift,
#if BEAM
                           float beam_origin,
#endif
                           __global float *expansions, int channel_pitch)
{
    const int entry = get_global_id(0) * WIDTH, tile = get_global_id(1);
    __global const float *centre = centres + 6 * tile;
    /* Expansions of channels beyond the tile's last are not used, but their geometry must be read within the rows. */
    const int channel = clamp(ranges[3 * (first_range + tile)] + entry, 0, geometry_pitch - WIDTH);
    const Vector column = uniform_vector(column_step), row = uniform_vector(row_step);

    const Vector transmitter = to_centre(geometry, geometry_pitch, TRANSMITTER, channel, centre);
    const Taylor out = distance_expansion(transmitter, column, row);
#if BISTATIC
    const Vector receiver = to_centre(geometry, geometry_pitch, RECEIVER, channel, centre);
#if MOVING
    const Vector velocity = channel_vector(geometry, geometry_pitch, VELOCITY, channel);
    const Vector arrival = from_receiver_at_arrival(transmitter, receiver, velocity);
    const Taylor back = distance_expansion(arrival, column, row);
    const Taylor path = moving_path_expansion(out, back, arrival, velocity, column, row);
#else
    const Taylor path = sum_of_expansions(out, distance_expansion(receiver, column, row));
#endif
    Taylor range = scaled_expansion(path, 0.5f * samples_per_m);
#else
    Taylor range = scaled_expansion(out, samples_per_m);
#endif
    range.i -= drift.x;
    range.j -= drift.y;
    __global float *expansion = expansions + (size_t)tile * EXPANSION_TERMS * channel_pitch + entry;
    store_expansion(range, expansion, channel_pitch);

#if BEAM
    const Vector along = channel_vector(geometry, geometry_pitch, ALONG, channel);
#if BISTATIC
    const Vector middle = midpoint(transmitter, receiver);
    const Taylor distance = distance_expansion(middle, column, row);
#else
    const Vector middle = transmitter;
    const Taylor distance = out;
#endif
    vfloat aspect;
    const Taylor change = aspect_expansion(middle, along, distance, &aspect, column, row);
    STORE(aspect - beam_origin, expansion + RANGE_TERMS * channel_pitch);
    store_expansion(change, expansion + (RANGE_TERMS + 1) * channel_pitch, channel_pitch);
#endif
}
