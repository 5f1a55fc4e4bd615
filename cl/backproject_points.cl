/* Backprojection onto points anywhere: adds to every point x the sum over channels
 *
 *     I(x) += sum_n w_n(x) s_n(rho_n(x)) exp(+j 2 pi cycles_n(x)),
 *
 * where the points form groups of STACK blocks of WIDTH points about a common centre. distance_change() (geometry.h) finds
 * how much the range of every point differs from the centre's. The same kernel forms exact images and the leaves of
 * factorized ones (ALIGNED).
 *
 * Build options: WIDTH and PERMUTE (vectors.h), HALF (samples.h), TAPS and WINDOWS (lookup.h), PHASE_TERMS (phases.h),
 * BEAM, ONE_CUBIC and NORMALISE (beam.h), OVERWRITE (pixels.h), ALIGNED (parts.h), CORRECTED (with ALIGNED: ranges have
 * corrections), BISTATIC and MOVING (antennas.h).
 *
 * lines, line_pitch     see samples.h.
 * ranges, reference_... see parts.h; the parts are groups.
 * corrections           with CORRECTED: float [groups][channel_pitch], m that are added to ranges, from a group's first channel
 *                       on; groups are those of `ranges`.
 * drift                 with ALIGNED: how much shorter every range becomes because receivers move, per metre along x y z.
 * geometry, centres     see antennas.h; `centres` holds those of all groups, from number first_range on those at work.
 * groups                number of groups at work.
 * offsets               float [3][points], m from the groups' centres: x y z of the points of all groups.
 * samples_per_m         samples per metre of range, which is half a path.
 * cycles_per_sample     phase per sample of range.
 * filter                see interpolation.h.
 * phase_polynomials     see phases.h.
 * beam_...              see beam.h.
 * represented, weight_sums  as for backproject_tiles.
 * pixels                float2, STACK WIDTH per group, from group number first_group on.
 *
 * Global size: groups, or more.
 */

#define CHANNEL_VALUES(p) (*(p))
#include "antennas.h"
#include "beam.h"
#include "parts.h"
#include "pixels.h"

/* Vectors from the antennas of one channel to a group's centre, the same in all lanes. */
typedef struct {
    Vector transmitter;
#if BISTATIC
    Vector receiver; /* at the arrival of the centre's echo */
#endif
#if MOVING
    Vector velocity;
#endif
#if BEAM
    Vector middle; /* of transmitter and receiver at transmission */
    Vector along;
#endif
} Antennas;

INLINE Antennas antennas_of(__global const float *geometry, int geometry_pitch, int channel, __global const float *centre)
{
    Antennas antennas;
    antennas.transmitter = to_centre(geometry, geometry_pitch, TRANSMITTER, channel, centre);
#if BISTATIC
    const Vector receiver = to_centre(geometry, geometry_pitch, RECEIVER, channel, centre);
#if MOVING
    antennas.velocity = channel_vector(geometry, geometry_pitch, VELOCITY, channel);
    antennas.receiver = from_receiver_at_arrival(antennas.transmitter, receiver, antennas.velocity);
#else
    antennas.receiver = receiver;
#endif
#endif
#if BEAM
#if BISTATIC
    antennas.middle = midpoint(antennas.transmitter, receiver);
#else
    antennas.middle = antennas.transmitter;
#endif
    antennas.along = channel_vector(geometry, geometry_pitch, ALONG, channel);
#endif
    return antennas;
}

/* How much longer the two-way path is to points than to their group's centre, m. */
INLINE vfloat path_change(const Antennas *antennas, Vector offset)
{
    const vfloat out = distance_change(antennas->transmitter, offset);
#if MOVING
    return out + moving_distance_change(antennas->receiver, sum_of(offset, -out, antennas->velocity), antennas->velocity);
#elif BISTATIC
    return out + distance_change(antennas->receiver, offset);
#else
    return 2.0f * out;
#endif
}

#if BEAM
/* The weights of a channel at points. */
INLINE vfloat point_weights(const Antennas *antennas, const Beam *beam, Vector offset)
{
    const Vector D = sum_of(antennas->middle, 1.0f, offset);
    const vfloat aspect = scalar_product(antennas->along, D) / sqrt(scalar_product(D, D) + FLT_MIN);
    const vfloat coordinate = aspect - beam->origin;
#if ONE_CUBIC
    const vfloat interval = intervals_at(coordinate);
    return weights_in(beam, LANE(interval, MIDDLE), coordinate);
#else
    return weights_at(beam, coordinate);
#endif
}
#endif

__kernel void backproject_points(__global const sample_t *lines, int line_pitch, __global const int *ranges,
                                 int first_range,
#if ALIGNED
                                 int centre_sample, float3 drift,
#if CORRECTED
                                 __global const float *corrections, int channel_pitch,
#endif
#else
                                 __global const int *reference_sample, __global const float *reference_fraction,
                                 __global const float *reference_phase, int channel_pitch,
#endif
                                 __global const float *geometry, int geometry_pitch, __global const float *centres,
                                 __global const float *offsets, int points, int groups, float samples_per_m,
                                 float cycles_per_sample, __global const float *filter,
                                 __global const float *phase_polynomials,
#if BEAM
                                 __global const float *beam_table, float beam_origin, float beam_low, float beam_high,
#if NORMALISE
#if ALIGNED
                                 __global const float *represented,
#endif
                                 __global float2 *weight_sums,
#endif
#endif
                                 __global float2 *pixels, int first_group)
{
    const int group = get_global_id(0);
    if (group >= groups)
        return;
    const Part part = part_at(ranges, first_range + group, lines, line_pitch);
#if !OVERWRITE
    if (part.begin >= part.end)
        return;
#endif
    offsets += (size_t)(first_range + group) * STACK * WIDTH;
    __global const float *centre = centres + 6 * (first_range + group);
#if BEAM
    const Beam beam = {beam_table, beam_origin, beam_low, beam_high};
#endif

    Sums sums;
    clear_sums(&sums);
    for (int channel = part.begin; channel < part.end; channel++) {
        const int entry = channel - part.begin;
        const Antennas antennas = antennas_of(geometry, geometry_pitch, channel, centre);
#if ALIGNED && CORRECTED
        const size_t pair = (size_t)(first_range + group) * channel_pitch + entry;
        const float correction = corrections[pair] * samples_per_m;
        const Reference reference = {centre_sample, correction, correction * cycles_per_sample};
#elif ALIGNED
        const Reference reference = {centre_sample, 0.0f, 0.0f};
#else
        const size_t pair = (size_t)group * channel_pitch + entry;
        const Reference reference = {reference_sample[pair], reference_fraction[pair], reference_phase[pair]};
#endif
        /* interpolate() expects positions that are half a sample less. */
        const float start = reference.fraction - 0.5f;
#if BEAM && NORMALISE && ALIGNED
        const float channels = represented[channel];
#else
        const float channels = 1.0f;
#endif
        __global const sample_t *line = LINE(part.lines, entry, line_pitch);
#if WINDOWS == 1
        const Lookup lookup = lookup_about(line, line_pitch, reference.sample, start);
#endif
#pragma unroll
        for (int block = 0; block < STACK; block++) {
            __global const float *x = offsets + block * WIDTH;
            const Vector offset = {LOAD(x), LOAD(x + points), LOAD(x + 2 * (size_t)points)};
            /* Weights come first: after the path they would take 10 % longer, as more registers are spilled. */
#if BEAM
            const vfloat weight = point_weights(&antennas, &beam, offset);
#else
            const vfloat weight = 1.0f;
#endif
            const vfloat path = path_change(&antennas, offset);
#if ALIGNED
            const vfloat samples = (0.5f * path - scalar_product(uniform_vector(drift), offset)) * samples_per_m;
#else
            const vfloat samples = path * (0.5f * samples_per_m);
#endif
            const vfloat t = samples + start;
#if WINDOWS > 1
            const Lookup lookup = lookup_about(line, line_pitch, reference.sample, LANE(t, MIDDLE));
#endif
            add_echoes(&sums, block, &lookup, t, filter, samples * cycles_per_sample + reference.phase,
                       phase_polynomials, weight, channels);
        }
    }

    put_blocks(sums.re, sums.im, pixels, BLOCK_COLUMNS, (first_group + group) * ITEM_ROWS, 0);
#if BEAM && NORMALISE
    put_blocks(sums.weight, sums.weight, weight_sums, BLOCK_COLUMNS, (first_group + group) * ITEM_ROWS, 0);
#endif
}
