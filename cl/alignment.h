/* Lines of channels, aligned on a child's centre: shifted by a short filter, and turned by a phase.
 *
 * For the stage kernel; its build options are told in stage.cl.
 */

#include "geometry.h"
#include "interpolation.h"
#include "phases.h"
#include "samples.h"

/* Rows that a channel adds to. */
#define ACROSS_TAPS (ROWS ? APERTURE_TAPS : 1)

/* Samples that are aligned at a time: the first stage's long lines are fetched in long pieces. */
#define BLOCK (WIDTH > 1 ? (SHIFTS_GIVEN ? 16 : 8) * WIDTH : 1)

/* Lines of different channels lie apart, so a CPU prefetches those of a later channel. Simulators lack the builtin. */
#if defined(__clang__) && WIDTH > 1 && !defined(NO_PREFETCH)
#define PREFETCH(p) __builtin_prefetch((const void *)(size_t)(p))
#define CHANNELS_AHEAD 4
#endif

/* The lines of a child's parent. */
typedef struct {
    __global const sample_t *lines;
    int pitch;
#if SHIFTS_GIVEN
    __global const int *order;
#else
    int first_channel;
#endif
} Parent;

INLINE __global const sample_t *line_of(const Parent *parent, int channel)
{
#if SHIFTS_GIVEN
    return LINE(parent->lines, parent->order[channel], parent->pitch);
#else
    return LINE(parent->lines, channel - parent->first_channel, parent->pitch);
#endif
}

/* What a chunk of channels is aligned and summed with. */
typedef struct {
    float range_weight[TAPS][CHUNK], aperture_weight[APERTURE_TAPS][CHUNK];
#if ROWS == 1
    float row_weight[ACROSS_TAPS][CHUNK];
#endif
    float cosine[CHUNK], sine[CHUNK]; /* of the phase; with RAMP of its change over WIDTH samples */
#if RAMP
    float phase[CHUNK]; /* at the child's centre, cycles */
#endif
    int start[CHUNK];
} Chunk;

/* A chunk's lines over a block of samples, aligned on the child's centre. */
typedef struct {
    vfloat re[BLOCK / WIDTH][CHUNK], im[BLOCK / WIDTH][CHUNK];
} Aligned;

/* How WIDTH channels are aligned: by `start` and `nu` samples, and a phase. */
typedef struct {
    vint start;
    vfloat nu, cycles;
} Shifts;

#if !SHIFTS_GIVEN
/* Shifts from the change of range between the parent's centre and the child's. */
INLINE Shifts shifts_to_child(__global const float *position, int channel_pitch, __global const float *offset, float3 drift,
                              float samples_per_m, float cycles_per_m, int first_sample)
{
    const Vector from_channel = {offset[0] - LOAD(position), offset[1] - LOAD(position + channel_pitch),
                                 offset[2] - LOAD(position + 2 * channel_pitch)};
    const float3 move = (float3)(offset[3], offset[4], offset[5]);
    const float drifted = drift.x * move.x + drift.y * move.y + drift.z * move.z;
    const vfloat change = distance_change(from_channel, uniform_vector(move)) - drifted;
    /* Half a sample less makes rounding find the lower of the two middle taps. */
    const vfloat shift = change * samples_per_m - 0.5f;
    const vfloat shifted = shift + ROUNDER;
    return (Shifts){VINT_OF_SHIFTED(shifted) + first_sample, shift - (shifted - ROUNDER), change * cycles_per_m};
}
#endif

/* Stores the weights of channels c to c + WIDTH - 1 of a chunk. */
INLINE void store_weights(__local Chunk *chunk, int c, Shifts shifts, __global const float *range_filter,
                          __global const float *aperture_filter, vfloat tap_position)
{
    for (int lane = 0; lane < WIDTH; lane++)
        chunk->start[c + lane] = INT_LANE(shifts.start, lane);
    vfloat weight[TAPS];
    filter_weights(range_filter, TAPS, shifts.nu, weight);
#pragma unroll
    for (int t = 0; t < TAPS; t++)
        STORE_LOCAL(weight[t], &chunk->range_weight[t][c]);
#if APERTURE_TAPS > 1
    vfloat share[APERTURE_TAPS];
    filter_weights(aperture_filter, APERTURE_TAPS, tap_position, share);
#else
    const vfloat share[1] = {1.0f};
#endif
#pragma unroll
    for (int t = 0; t < APERTURE_TAPS; t++)
        STORE_LOCAL(share[t], &chunk->aperture_weight[t][c]);
}

/* WIDTH samples of a line, filtered: sum_t weight[t] line[k + t]. */
#if defined(__clang__) && WIDTH >= 8
/* The vectors at k, `low`, and after it, `high`, are shuffled by constants: loads that cross cache lines are slower. */
#define SLIDING
#if WIDTH == 16
#define SHIFTED(low, high, t)                                                                          \
    __builtin_shufflevector(low, high, t, t + 1, t + 2, t + 3, t + 4, t + 5, t + 6, t + 7, t + 8, t + 9, \
                            t + 10, t + 11, t + 12, t + 13, t + 14, t + 15)
#else
#define SHIFTED(low, high, t) \
    __builtin_shufflevector(low, high, t, t + 1, t + 2, t + 3, t + 4, t + 5, t + 6, t + 7)
#endif
INLINE vfloat filtered(const float *weight, vfloat low, vfloat high)
{
    /* One product at a time: a compiler does not fuse a sum of two products with what it is added to. */
    vfloat sum = weight[0] * low;
    sum += weight[1] * SHIFTED(low, high, 1);
#if TAPS > 2
    sum += weight[2] * SHIFTED(low, high, 2);
    sum += weight[3] * SHIFTED(low, high, 3);
#endif
#if TAPS > 4
    sum += weight[4] * SHIFTED(low, high, 4);
    sum += weight[5] * SHIFTED(low, high, 5);
#endif
#if TAPS > 6
    sum += weight[6] * SHIFTED(low, high, 6);
    sum += weight[7] * SHIFTED(low, high, 7);
#endif
    return sum;
}
#endif

/* Aligns channel c of a chunk, whose line this is, over samples `block` to `end` - 1. `next` is where, less `block`, to
 * prefetch from. */
INLINE void align_line(Aligned *aligned, __local const Chunk *chunk, int c, __global const sample_t *line, int pitch,
                       int block, int end, vfloat phase_re, vfloat phase_im, __global const sample_t *next)
{
    float weight[TAPS];
#pragma unroll
    for (int t = 0; t < TAPS; t++)
        weight[t] = chunk->range_weight[t][c];
#if RAMP
    const float step_re = chunk->cosine[c], step_im = chunk->sine[c];
#endif
    const int start = chunk->start[c];
#ifdef SLIDING
    const int before = CLAMP(start + block, 0, pitch - TAPS - WIDTH);
    vfloat re_low = LOAD_RE(line, before, pitch), im_low = LOAD_IM(line, before, pitch);
#endif
    for (int k = block; k < end; k += WIDTH) {
#ifdef PREFETCH
        PREFETCH(next + k);
        PREFETCH(next + k + pitch);
#endif
#ifdef SLIDING
        const int after = CLAMP(start + k + WIDTH, 0, pitch - WIDTH);
        const vfloat re_high = LOAD_RE(line, after, pitch), im_high = LOAD_IM(line, after, pitch);
        const vfloat re = filtered(weight, re_low, re_high), im = filtered(weight, im_low, im_high);
        re_low = re_high;
        im_low = im_high;
#else
        const int position = CLAMP(start + k, 0, pitch - TAPS - WIDTH);
        vfloat re = 0.0f, im = 0.0f;
#pragma unroll
        for (int t = 0; t < TAPS; t++) {
            re += weight[t] * LOAD_RE(line, position + t, pitch);
            im += weight[t] * LOAD_IM(line, position + t, pitch);
        }
#endif
        aligned->re[(k - block) / WIDTH][c] = re * phase_re - im * phase_im;
        aligned->im[(k - block) / WIDTH][c] = re * phase_im + im * phase_re;
#if RAMP
        const vfloat turned = phase_re * step_re - phase_im * step_im;
        phase_im = phase_re * step_im + phase_im * step_re;
        phase_re = turned;
#endif
    }
}
