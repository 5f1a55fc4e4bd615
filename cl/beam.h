/* Beam weights of channels, which depend on the sine of the aspect angle to a pixel.
 *
 * With u the track's direction at a channel and e the unit vector to the pixel from the middle of transmitter and
 * receiver, u.e is the sine of the aspect angle, over which the weights are tabulated. The table coordinate of a pixel is
 * u.e - beam_origin; the host has scaled u and beam_origin to intervals of the table.
 *
 * Build options
 *   BEAM       intervals of the table; 0: no weights.
 *   ONE_CUBIC  1: pixels lie so close together that one cubic serves all pixels of a work-item (tiles), or all points of
 *              a block (points); 0: every block, or every point, has its own.
 *   NORMALISE  1: also sum the weights.
 *
 * beam_table: float [BEAM][4], the weight as a cubic for each interval, in a variable that goes from 0 to 1 over the
 * interval; constant terms come first. Weights are 0 at table coordinates up to beam_low and from beam_high on.
 */

#include "vectors.h"

typedef struct {
    __global const float *table;
    float origin, low, high;
} Beam;

/* Number of the interval that contains a table coordinate, as a float. Every coordinate, including NaN, gives an interval
 * of the table. */
#define DEFINE_INTERVAL_AT(type, name)                                     \
    INLINE type name(type coordinate)                                      \
    {                                                                      \
        type nearest = ROUNDED(coordinate - 0.5f);                         \
        nearest = nearest > 0.0f ? nearest : (type)0.0f;                   \
        return nearest < BEAM - 1.0f ? nearest : (type)(BEAM - 1.0f);      \
    }

#if BEAM
DEFINE_INTERVAL_AT(vfloat, intervals_at)

/* Values of cubics at x, or 0 where the table coordinate lies outside (low, high). */
INLINE vfloat weights_within(vfloat c0, vfloat c1, vfloat c2, vfloat c3, vfloat x, vfloat coordinate, const Beam *beam)
{
    vfloat weight = c0 + x * (c1 + x * (c2 + x * c3));
    weight = coordinate > beam->low ? weight : (vfloat)0.0f;
    return coordinate < beam->high ? weight : (vfloat)0.0f;
}

/* The weights at table coordinates that share the cubic of an interval. */
INLINE vfloat weights_in(const Beam *beam, float interval, vfloat coordinate)
{
    __global const float *cubic = beam->table + 4 * ROUNDED_INT(interval);
    return weights_within(cubic[0], cubic[1], cubic[2], cubic[3], coordinate - interval, coordinate, beam);
}

/* The weights at table coordinates, each by the cubic of its own interval. */
INLINE vfloat weights_at(const Beam *beam, vfloat coordinate)
{
    const vfloat nearest = intervals_at(coordinate);
    const vint interval = VINT_OF_SHIFTED(nearest + ROUNDER);
    vfloat c0, c1, c2, c3;
#pragma unroll
    for (int lane = 0; lane < WIDTH; lane++) {
        __global const float *cubic = beam->table + 4 * INT_LANE(interval, lane);
        LANE(c0, lane) = cubic[0];
        LANE(c1, lane) = cubic[1];
        LANE(c2, lane) = cubic[2];
        LANE(c3, lane) = cubic[3];
    }
    return weights_within(c0, c1, c2, c3, coordinate - nearest, coordinate, beam);
}
#endif
