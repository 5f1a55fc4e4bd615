/* The lines of a child's parent, and by how much each is shifted and turned to be aligned on the child's centre.
 *
 * Build options
 *   SHIFTS_GIVEN  1: the host gives shifts and phases (first stage, whose channels may be anywhere); 0: they are computed
 *                 here from the positions of virtual channels (later stages).
 *   RAMP          1: phases vary along the lines (only with SHIFTS_GIVEN); 0: they are constant.
 *
 * Kernel parameters with SHIFTS_GIVEN, per root and channel, [roots][channel_pitch]:
 * order          int: number of the channel's line.
 * start          int: sample of the line under tap 0 of the range filter, for the child's sample 0.
 * nu             float: position between the filter's two middle taps, -0.5 to 0.5 samples from their middle.
 * cycles         float: phase at the child's centre, cycles.
 * ramp           float, with RAMP: change of the phase, cycles per sample.
 *
 * Kernel parameters without SHIFTS_GIVEN:
 * parents        int [children_per_root]: number of each child's parent, among the parents_per_root of the root. Every
 *                parent at work has lines_per_parent lines.
 * positions      float [roots][3][channel_pitch]: of channels, m from the root's centre.
 * offsets        float [roots][children_per_root][6]: the parent's centre from the root's, then the child's centre from
 *                the parent's, m.
 * drift          velocity of the receivers over the sound speed. To first order, motion during the echo's flight adds
 *                -drift.(x - channel) to the range of x.
 * samples_per_m, cycles_per_m  samples and phase per metre of range.
 * parent_centre  sample of a parent's line at the parent's centre.
 */

#include "geometry.h"
#include "samples.h"

/* How WIDTH channels are aligned. find_shifts() is passed where to put them: Oclgrind (21.10) cannot run what LLVM makes of
 * a function that returns them. */
typedef struct {
    vint start;
    vfloat nu, cycles, ramp;
} Shifts;

#if SHIFTS_GIVEN
typedef struct {
    __global const sample_t *lines;
    int pitch, first_channel; /* the latter is not used here */
    __global const int *order, *start;
    __global const float *nu, *cycles, *ramp;
} Parent;

INLINE __global const sample_t *line_of(const Parent *parent, int channel)
{
    return LINE(parent->lines, parent->order[channel], parent->pitch);
}

/* Finds the shifts of the WIDTH channels from number `channel` on. */
INLINE void find_shifts(const Parent *parent, int channel, Shifts *shifts)
{
    shifts->start = AS_VINT(LOAD((__global const float *)(parent->start + channel)));
    shifts->nu = LOAD(parent->nu + channel);
    shifts->cycles = LOAD(parent->cycles + channel);
    if (RAMP)
        shifts->ramp = LOAD(parent->ramp + channel);
}
#else
typedef struct {
    __global const sample_t *lines;
    int pitch, first_channel; /* the channel of the first line */
    __global const float *positions;
    int channel_pitch;
    __global const float *offset; /* of this child */
    float3 drift;
    float samples_per_m, cycles_per_m;
    int first_sample; /* under tap 0, for the child's sample 0, if no range changed */
} Parent;

INLINE __global const sample_t *line_of(const Parent *parent, int channel)
{
    return LINE(parent->lines, channel - parent->first_channel, parent->pitch);
}

/* Finds the shifts of the WIDTH channels from number `channel` on, from the change of range between the parent's centre
 * and the child's. */
INLINE void find_shifts(const Parent *parent, int channel, Shifts *shifts)
{
    __global const float *position = parent->positions + channel, *offset = parent->offset;
    const float3 drift = parent->drift;
    const Vector from_channel = {offset[0] - LOAD(position), offset[1] - LOAD(position + parent->channel_pitch),
                                 offset[2] - LOAD(position + 2 * parent->channel_pitch)};
    const float3 move = (float3)(offset[3], offset[4], offset[5]);
    const float drifted = drift.x * move.x + drift.y * move.y + drift.z * move.z;
    const vfloat change = distance_change(from_channel, uniform_vector(move)) - drifted;
    /* Rounding half a sample less finds the lower of the two middle taps. */
    const vfloat shift = change * parent->samples_per_m - 0.5f;
    const vfloat shifted = shift + ROUNDER;
    shifts->start = VINT_OF_SHIFTED(shifted) + parent->first_sample;
    shifts->nu = shift - (shifted - ROUNDER);
    shifts->cycles = change * parent->cycles_per_m;
}
#endif
