/* Lines of channels, aligned on a child's centre: shifted by a short filter, and turned by a phase.
 *
 * Channels are aligned in chunks. A GPU aligns a sample when it is asked for. A CPU first aligns a block of samples of all
 * lines of a chunk.
 *
 * Build options: see stages.h and shifts.h.
 */

#include "interpolation.h"
#include "phases.h"
#include "shifts.h"
#include "sliding_filter.h"
#include "stages.h"

/* 1: registers hold the sums of all virtual channels that are open at a time, as those of a GPU and the 32 of AVX-512 do;
 * 0: sums are finished one after the other (combination.h). */
#define RUNNING_SUMS (WIDTH == 1 || AVX == 512)

/* Weights and phases of a chunk of channels. */
typedef struct {
    float range_weight[TAPS][CHUNK], aperture_weight[APERTURE_TAPS * CHUNK]; /* tap by tap */
    float cosine[CHUNK], sine[CHUNK]; /* of the phase; with RAMP of its change over WIDTH samples */
    float phase[RAMP ? CHUNK : 1];    /* with RAMP: at the child's centre, cycles */
    float ramp[RAMP ? CHUNK : 1];
    int start[CHUNK];
    /* Without RUNNING_SUMS: where aperture_weight has a channel's weight for a virtual channel, less CHUNK times the
     * number of the latter. */
    int weight_of[RUNNING_SUMS ? 1 : CHUNK];
} Chunk;

/* Computes the weights and phases of `count` channels from number `first` on. */
INLINE void fill_chunk(__local Chunk *chunk, const Parent *parent, int first, int count,
                       __global const int *first_virtual, __global const float *tap_position, const Filters *filters,
                       const Share *share)
{
    for (int c = share->item * WIDTH; c < count; c += share->items * WIDTH) {
        const int channel = first + c;
        Shifts shifts;
        find_shifts(parent, channel, &shifts);
        for (int lane = 0; lane < WIDTH; lane++)
            chunk->start[c + lane] = INT_LANE(shifts.start, lane);
        vfloat range_weight[TAPS];
        filter_weights(filters->range, TAPS, shifts.nu, range_weight);
#pragma unroll
        for (int t = 0; t < TAPS; t++)
            STORE_LOCAL(range_weight[t], &chunk->range_weight[t][c]);
        vfloat aperture_weight[APERTURE_TAPS];
        if (APERTURE_TAPS > 1)
            filter_weights(filters->aperture, APERTURE_TAPS, LOAD(tap_position + channel), aperture_weight);
        else
            aperture_weight[0] = 1.0f;
#pragma unroll
        for (int t = 0; t < APERTURE_TAPS; t++)
            STORE_LOCAL(aperture_weight[t], &chunk->aperture_weight[t * CHUNK + c]);
        if (!RUNNING_SUMS)
            for (int lane = 0; lane < WIDTH; lane++)
                chunk->weight_of[c + lane] = c + lane - CHUNK * first_virtual[channel + lane];
        vfloat turn = shifts.cycles, sine, cosine;
        if (RAMP) {
            STORE_LOCAL(shifts.cycles, &chunk->phase[c]);
            STORE_LOCAL(shifts.ramp, &chunk->ramp[c]);
            turn = WIDTH * shifts.ramp;
        }
        sine_and_cosine(turn, filters->phases, &sine, &cosine);
        STORE_LOCAL(cosine, &chunk->cosine[c]);
        STORE_LOCAL(sine, &chunk->sine[c]);
    }
}

/* How one channel of a chunk is aligned, and its line. */
typedef struct {
    __global const sample_t *line;
    int pitch;
    float weight[TAPS];
    vfloat phase_re, phase_im;
    float step_re, step_im; /* with RAMP: turn of the phase over WIDTH samples */
} Channel;

/* Channel c of a chunk, number `number` of all, with the phase at a sample `from_centre` samples after the child's
 * centre. */
INLINE Channel channel_at(__local const Chunk *chunk, int c, const Parent *parent, int number, int from_centre,
                          __global const float *phase_polynomials)
{
    Channel channel = {line_of(parent, number), parent->pitch};
#pragma unroll
    for (int t = 0; t < TAPS; t++)
        channel.weight[t] = chunk->range_weight[t][c];
    if (RAMP) {
        sine_and_cosine(chunk->phase[c] + chunk->ramp[c] * (LANES + (float)from_centre), phase_polynomials,
                        &channel.phase_im, &channel.phase_re);
        channel.step_re = chunk->cosine[c];
        channel.step_im = chunk->sine[c];
    } else {
        channel.phase_re = chunk->cosine[c];
        channel.phase_im = chunk->sine[c];
    }
    return channel;
}

#if WIDTH == 1
#define BLOCK 1

/* A sample of the aligned lines of a chunk: what it takes to align them. */
typedef struct {
    const Parent *parent;
    __local const Chunk *chunk;
    int first; /* number of the chunk's first channel */
    int k, from_centre;
    __global const float *phase_polynomials;
} Block;

INLINE void align_block(Block *block, const Parent *parent, __local const Chunk *chunk, int first, int count, int k,
                        int vectors, int from_centre, __global const float *phase_polynomials)
{
    *block = (Block){parent, chunk, first, k, from_centre, phase_polynomials};
}

INLINE void aligned_samples(const Block *block, int n, int c, float *re, float *im)
{
    __local const Chunk *chunk = block->chunk;
    const Channel channel =
        channel_at(chunk, c, block->parent, block->first + c, block->from_centre, block->phase_polynomials);
    __global const sample_t *sample = channel.line + 2 * CLAMP(chunk->start[c] + block->k, 0, channel.pitch - TAPS - 1);
    float2 sum = 0.0f;
#pragma unroll
    for (int t = 0; t < TAPS; t++)
        sum += channel.weight[t] * LOAD_PAIR(sample + 2 * t);
    *re = sum.x * channel.phase_re - sum.y * channel.phase_im;
    *im = sum.x * channel.phase_im + sum.y * channel.phase_re;
}
#else
/* Samples of a block. The first stage's long lines are fetched in long pieces. */
#define BLOCK ((SHIFTS_GIVEN ? 18 : 12) * WIDTH)

/* A block of the aligned lines of a chunk. */
typedef struct {
    vfloat re[BLOCK / WIDTH][CHUNK], im[BLOCK / WIDTH][CHUNK];
} Block;

/* Lines of different channels lie apart, so a CPU prefetches those of a later channel. PoCL's prefetch() does nothing, so
 * the compiler's builtin is used where it compiles for a processor. A driver that translates to SPIR-V, and so knows no
 * processor, may crash on the builtin (Mesa 25.0). */
#if defined(__clang__) && (defined(__x86_64__) || defined(__aarch64__))
#define PREFETCH(p) __builtin_prefetch((const void *)(size_t)(p))
#else
#define PREFETCH(p) prefetch((__global const float *)(p), 16)
#endif
#define CHANNELS_AHEAD 4
#define CACHE_LINE (64 / (int)sizeof(sample_t)) /* samples */

/* Prefetches what align_line() reads of a line. */
INLINE void prefetch_line(__global const sample_t *line, int pitch, int start, int vectors)
{
    line += CLAMP(start, 0, pitch - BLOCK - WIDTH);
    for (int k = 0; k < vectors * WIDTH; k += CACHE_LINE) {
        PREFETCH(line + k);
        PREFETCH(line + k + pitch);
    }
}

/* Turns a vector by the channel's phase, and stores it; with RAMP the phase moves on to the next vector. */
INLINE void store_aligned(Block *block, int n, int c, Channel *channel, vfloat re, vfloat im)
{
    block->re[n][c] = re * channel->phase_re - im * channel->phase_im;
    block->im[n][c] = re * channel->phase_im + im * channel->phase_re;
    if (RAMP) {
        const vfloat turned = channel->phase_re * channel->step_re - channel->phase_im * channel->step_im;
        channel->phase_im = channel->phase_re * channel->step_im + channel->phase_im * channel->step_re;
        channel->phase_re = turned;
    }
}

#ifdef SLIDING
/* The vector of samples to read for those from number k on: k itself, or the nearest within the line. */
#define POSITION(k) (is_inside ? (k) : CLAMP(k, 0, channel.pitch - WIDTH))

INLINE void slide_along(Block *block, int c, Channel channel, int start, int vectors, const int is_inside)
{
    vfloat re_low = LOAD_RE(channel.line, POSITION(start), channel.pitch);
    vfloat im_low = LOAD_IM(channel.line, POSITION(start), channel.pitch);
    for (int n = 0; n < vectors; n++) {
        const int after = POSITION(start + (n + 1) * WIDTH);
        const vfloat re_high = LOAD_RE(channel.line, after, channel.pitch);
        const vfloat im_high = LOAD_IM(channel.line, after, channel.pitch);
        store_aligned(block, n, c, &channel, filtered(channel.weight, re_low, re_high),
                      filtered(channel.weight, im_low, im_high));
        re_low = re_high;
        im_low = im_high;
    }
}
#endif

/* Aligns channel c of a chunk over some vectors, the first of which begins at the line's sample `start`. */
INLINE void align_line(Block *block, int c, Channel channel, int start, int vectors)
{
#ifdef SLIDING
    if (start >= 0 && start + (vectors + 1) * WIDTH <= channel.pitch)
        slide_along(block, c, channel, start, vectors, 1);
    else
        slide_along(block, c, channel, start, vectors, 0);
#else
    for (int n = 0; n < vectors; n++) {
        const int position = CLAMP(start + n * WIDTH, 0, channel.pitch - TAPS - WIDTH);
        vfloat re = 0.0f, im = 0.0f;
#pragma unroll
        for (int t = 0; t < TAPS; t++) {
            re += channel.weight[t] * LOAD_RE(channel.line, position + t, channel.pitch);
            im += channel.weight[t] * LOAD_IM(channel.line, position + t, channel.pitch);
        }
        store_aligned(block, n, c, &channel, re, im);
    }
#endif
}

/* Aligns a chunk's `count` lines over some vectors from sample k on, which is `from_centre` samples after the centre. */
INLINE void align_block(Block *block, const Parent *parent, __local const Chunk *chunk, int first, int count, int k,
                        int vectors, int from_centre, __global const float *phase_polynomials)
{
    for (int c = 0; c < count; c++) {
        const int ahead = c + CHANNELS_AHEAD < count ? c + CHANNELS_AHEAD : count - 1;
        prefetch_line(line_of(parent, first + ahead), parent->pitch, chunk->start[ahead] + k, vectors);
        const Channel channel = channel_at(chunk, c, parent, first + c, from_centre, phase_polynomials);
        align_line(block, c, channel, chunk->start[c] + k, vectors);
    }
}

INLINE void aligned_samples(const Block *block, int n, int c, vfloat *re, vfloat *im)
{
    *re = block->re[n][c];
    *im = block->im[n][c];
}
#endif
