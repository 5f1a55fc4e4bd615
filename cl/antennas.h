/* Positions of antennas relative to the centres of tiles or groups of points.
 *
 * Positions are float32 differences from an origin nearby. The host splits each into the nearest float32 number and its
 * remainder, so that a short distance between two points far from the origin stays exact.
 *
 * Build options
 *   BISTATIC  1: receivers have positions of their own; 0: they are the transmitters.
 *   MOVING    1: receivers move during the echo's flight.
 *   BEAM      not 0: the track's direction is needed (beam.h).
 * Before it includes this file, a kernel defines CHANNEL_VALUES(p): what its lanes load for the channels from pointer p on.
 *
 * geometry: float [rows][geometry_pitch], a column per channel. The rows: transmitter x y z, then their remainders (m,
 * from the origin); with BISTATIC the receiver's likewise; with MOVING the receiver's velocity x y z over the sound
 * speed; with BEAM the track's direction x y z, times intervals of the beam's table.
 * centres: float [parts][6], x y z of tiles or groups and their remainders (m, from the origin).
 */

#include "geometry.h"

#define TRANSMITTER 0
#define RECEIVER 6
#define VELOCITY 12
#if MOVING
#define ALONG 15
#elif BISTATIC
#define ALONG 12
#else
#define ALONG 6
#endif

/* Three rows of the geometry. */
INLINE Vector channel_vector(__global const float *geometry, int geometry_pitch, int row, int channel)
{
    __global const float *p = geometry + row * geometry_pitch + channel;
    return (Vector){CHANNEL_VALUES(p), CHANNEL_VALUES(p + geometry_pitch), CHANNEL_VALUES(p + 2 * geometry_pitch)};
}

/* The vector from an antenna to a centre. */
INLINE Vector to_centre(__global const float *geometry, int geometry_pitch, int row, int channel,
                        __global const float *centre)
{
    const Vector antenna = channel_vector(geometry, geometry_pitch, row, channel);
    const Vector remainder = channel_vector(geometry, geometry_pitch, row + 3, channel);
    return (Vector){(centre[0] - antenna.x) + (centre[3] - remainder.x),
                    (centre[1] - antenna.y) + (centre[4] - remainder.y),
                    (centre[2] - antenna.z) + (centre[5] - remainder.z)};
}

/* The vector to a point from a moving receiver, where that is when the point's echo arrives. It follows from the vectors to
 * the point from the transmitter and from the receiver at the time of transmission.
 *
 * When the sound reaches the point, the vector from the receiver to the point is d. The way back, of length l, satisfies
 * |d - l b| = l with the receiver's velocity b over the sound speed, or (1 - b.b) l^2 + 2 (d.b) l - d.d = 0. */
INLINE Vector from_receiver_at_arrival(Vector transmitter, Vector receiver, Vector velocity)
{
    const Vector d = sum_of(receiver, -magnitude(transmitter), velocity);
    const vfloat along = scalar_product(d, velocity), rest = 1.0f - scalar_product(velocity, velocity);
    const vfloat back = (sqrt(along * along + rest * scalar_product(d, d)) - along) / rest;
    return sum_of(d, -back, velocity);
}
