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
#if WIDTH > 1
#define BLOCK ((SHIFTS_GIVEN ? 18 : 12) * WIDTH)
#endif

/* Whether registers hold the sums of all virtual channels that are open at a time: a GPU's, and the 32 of AVX-512. */
#define RUNNING_SUMS (WIDTH == 1 || AVX == 512)

/* Lines of different channels lie apart, so a CPU prefetches those of a later channel. OpenCL's prefetch() does nothing in
 * PoCL, hence the compiler's builtin where PoCL compiles for a processor. A driver that translates to SPIR-V may end the
 * process when it meets the builtin (Mesa 25.0), and defines no processor. */
#if WIDTH > 1
#if defined(__clang__) && (defined(__x86_64__) || defined(__aarch64__))
#define PREFETCH(p) __builtin_prefetch((const void *)(size_t)(p))
#else
#define PREFETCH(p) prefetch((__global const float *)(p), 16)
#endif
#define CHANNELS_AHEAD 4
#define CACHE_LINE (64 / (int)sizeof(sample_t)) /* samples */
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

#ifdef PREFETCH
/* Prefetches what align_line() reads of a line. */
INLINE void prefetch_line(__global const sample_t *line, int pitch, int start, int vectors)
{
    line += CLAMP(start, 0, pitch - BLOCK - WIDTH);
    for (int k = 0; k < vectors * WIDTH; k += CACHE_LINE) {
        PREFETCH(line + k);
        PREFETCH(line + k + pitch);
    }
}
#endif

/* What a chunk of channels is aligned and summed with. */
typedef struct {
    float range_weight[TAPS][CHUNK], aperture_weight[APERTURE_TAPS * CHUNK]; /* tap by tap */
#if ROWS == 1
    float row_weight[ACROSS_TAPS][CHUNK];
#endif
    float cosine[CHUNK], sine[CHUNK]; /* of the phase; with RAMP of its change over WIDTH samples */
#if RAMP
    float phase[CHUNK]; /* at the child's centre, cycles */
    float ramp[CHUNK];
#endif
    int start[CHUNK];
#if !RUNNING_SUMS
    int weight_of[CHUNK]; /* less CHUNK times a virtual channel: where aperture_weight has the channel's for it */
#endif
} Chunk;

#if WIDTH > 1
/* A chunk's lines over a block of samples, aligned on the child's centre. */
typedef struct {
    vfloat re[BLOCK / WIDTH][CHUNK], im[BLOCK / WIDTH][CHUNK];
} Aligned;
#endif

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
        STORE_LOCAL(share[t], &chunk->aperture_weight[t * CHUNK + c]);
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
/* Both halves of a vector are shifted by one instruction, where compilers take two. */
#ifdef AVX
INLINE vfloat shifted_halves(vfloat low, vfloat high, const int t)
{
    vfloat shifted;
    __asm__("vpalignr %3, %1, %2, %0" : "=x"(shifted) : "x"(low), "x"(high), "i"(4 * t));
    return shifted;
}
#define SHIFTED_HALVES(low, high, t) shifted_halves(low, high, (t) & 3)
#else
#define HALF_LANE(lane, t) ((lane) + ((t) & 3) + ((lane) % 4 + ((t) & 3) < 4 ? 0 : 4))
#define SHIFTED_HALVES(low, high, t)                                                                                   \
    __builtin_shufflevector(low, high, HALF_LANE(0, t), HALF_LANE(1, t), HALF_LANE(2, t), HALF_LANE(3, t),             \
                            HALF_LANE(4, t), HALF_LANE(5, t), HALF_LANE(6, t), HALF_LANE(7, t))
#endif
#define BETWEEN(low, high) __builtin_shufflevector(low, high, 4, 5, 6, 7, 8, 9, 10, 11)
#define SHIFTED(low, high, t) \
    ((t) < 4 ? SHIFTED_HALVES(low, BETWEEN(low, high), t) : SHIFTED_HALVES(BETWEEN(low, high), high, t))
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

/* How one channel of a chunk is aligned, and its line. */
typedef struct {
    __global const sample_t *line;
    int pitch;
    float weight[TAPS];
    vfloat phase_re, phase_im;
#if RAMP
    float step_re, step_im; /* turn of the phase over WIDTH samples */
#endif
} Channel;

/* Channel c of a chunk, number `number` of all; its phase is that at a sample so far from the child's centre. */
INLINE Channel channel_at(__local const Chunk *chunk, int c, const Parent *parent, int number, int from_centre,
                          __global const float *phase_polynomials)
{
    Channel channel = {line_of(parent, number), parent->pitch};
#pragma unroll
    for (int t = 0; t < TAPS; t++)
        channel.weight[t] = chunk->range_weight[t][c];
#if RAMP
    sine_and_cosine(chunk->phase[c] + chunk->ramp[c] * (LANES + (float)from_centre), phase_polynomials, &channel.phase_im,
                    &channel.phase_re);
    channel.step_re = chunk->cosine[c];
    channel.step_im = chunk->sine[c];
#else
    channel.phase_re = chunk->cosine[c];
    channel.phase_im = chunk->sine[c];
#endif
    return channel;
}

#if WIDTH == 1
/* A chunk's lines at sample k of the child, which are aligned when they are asked for. */
typedef struct {
    const Parent *parent;
    int first; /* number of the chunk's first channel */
    int k, from_centre;
    __global const float *phase_polynomials;
} ChunkLines;

INLINE void aligned_samples(const ChunkLines *lines, __local const Chunk *chunk, int c, float *re, float *im)
{
    const Channel channel =
        channel_at(chunk, c, lines->parent, lines->first + c, lines->from_centre, lines->phase_polynomials);
    __global const sample_t *sample = channel.line + 2 * CLAMP(chunk->start[c] + lines->k, 0, channel.pitch - TAPS - 1);
    float2 sum = 0.0f;
#pragma unroll
    for (int t = 0; t < TAPS; t++)
        sum += channel.weight[t] * LOAD_PAIR(sample + 2 * t);
    *re = sum.x * channel.phase_re - sum.y * channel.phase_im;
    *im = sum.x * channel.phase_im + sum.y * channel.phase_re;
}
#else
/* A chunk's lines in a block: at vector n, or in all n vectors without RUNNING_SUMS. */
typedef struct {
    const Aligned *aligned;
    int n;
} ChunkLines;

INLINE void aligned_samples(const ChunkLines *lines, __local const Chunk *chunk, int c, vfloat *re, vfloat *im)
{
    *re = lines->aligned->re[lines->n][c];
    *im = lines->aligned->im[lines->n][c];
}

INLINE void store_aligned(Aligned *aligned, int n, int c, Channel *channel, vfloat re, vfloat im)
{
    aligned->re[n][c] = re * channel->phase_re - im * channel->phase_im;
    aligned->im[n][c] = re * channel->phase_im + im * channel->phase_re;
#if RAMP
    const vfloat turned = channel->phase_re * channel->step_re - channel->phase_im * channel->step_im;
    channel->phase_im = channel->phase_re * channel->step_im + channel->phase_im * channel->step_re;
    channel->phase_re = turned;
#endif
}

#ifdef SLIDING
/* Aligns a line of which POSITION(k) says where it is read for sample k: k itself, or within the line. */
#define ALIGN_VECTORS(POSITION)                                                               \
    {                                                                                         \
        vfloat re_low = LOAD_RE(channel.line, POSITION(start), channel.pitch);                \
        vfloat im_low = LOAD_IM(channel.line, POSITION(start), channel.pitch);                \
        for (int n = 0; n < vectors; n++) {                                                   \
            const int after = POSITION(start + (n + 1) * WIDTH);                              \
            const vfloat re_high = LOAD_RE(channel.line, after, channel.pitch);               \
            const vfloat im_high = LOAD_IM(channel.line, after, channel.pitch);               \
            store_aligned(aligned, n, c, &channel, filtered(channel.weight, re_low, re_high), \
                          filtered(channel.weight, im_low, im_high));                         \
            re_low = re_high;                                                                 \
            im_low = im_high;                                                                 \
        }                                                                                     \
    }
#define AS_IT_IS(k) (k)
#define WITHIN_LINE(k) CLAMP(k, 0, channel.pitch - WIDTH)
#endif

/* Aligns channel c of a chunk over so many vectors of a block, of which the first begins at the line's sample `start`. */
INLINE void align_line(Aligned *aligned, int c, Channel channel, int start, int vectors)
{
#ifdef SLIDING
    if (start >= 0 && start + (vectors + 1) * WIDTH <= channel.pitch)
        ALIGN_VECTORS(AS_IT_IS)
    else
        ALIGN_VECTORS(WITHIN_LINE)
#else
    for (int n = 0; n < vectors; n++) {
        const int position = CLAMP(start + n * WIDTH, 0, channel.pitch - TAPS - WIDTH);
        vfloat re = 0.0f, im = 0.0f;
#pragma unroll
        for (int t = 0; t < TAPS; t++) {
            re += channel.weight[t] * LOAD_RE(channel.line, position + t, channel.pitch);
            im += channel.weight[t] * LOAD_IM(channel.line, position + t, channel.pitch);
        }
        store_aligned(aligned, n, c, &channel, re, im);
    }
#endif
}
#endif
