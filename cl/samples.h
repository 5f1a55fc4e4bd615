/* The samples of range lines, in the form in which kernels pass them to one another.
 *
 * A line is `pitch` complex samples. With WIDTH > 1 its real parts come first, then its imaginary parts,
 * [lines][2][pitch]; with WIDTH 1 they are interleaved, [lines][pitch][2]. Kernels always compute in float.
 *
 * Build options
 *   HALF  1: both parts of a sample are stored as half, which takes half the memory and adds an error of -74 dB; 0: as
 *         float.
 */

#include "x86.h"

/* sample_t stores one part of a sample. LOAD_PART and STORE_PART move one part, LOAD_PARTS and STORE_PARTS move WIDTH
 * consecutive ones, and LOAD_PAIR and STORE_PAIR both parts of an interleaved sample. */
#if HALF
typedef half sample_t;
#define LOAD_PART(p) vload_half(0, p)
#define STORE_PART(value, p) vstore_half(value, 0, p)
#define LOAD_PAIR(p) vload_half2(0, p)
#define STORE_PAIR(value, p) vstore_half2(value, 0, p)
#if AVX
#define LOAD_PARTS(p) load_halves(p)
#define STORE_PARTS(value, p) store_halves(value, p)
#else
#define LOAD_PARTS(p) JOIN(vload_half, WIDTH)(0, p)
#define STORE_PARTS(value, p) JOIN(vstore_half, WIDTH)((vfloat)(value), 0, p)
#endif
#else
typedef float sample_t;
#define LOAD_PART(p) (*(p))
#define STORE_PART(value, p) (*(p) = (value))
#define LOAD_PAIR(p) (*(__global const float2 *)(p))
#define STORE_PAIR(value, p) (*(__global float2 *)(p) = (value))
#define LOAD_PARTS(p) LOAD(p)
#define STORE_PARTS(value, p) STORE(value, p)
#endif

/* Line `number` of lines. */
#define LINE(lines, number, pitch) ((lines) + (size_t)(number) * 2 * (pitch))

/* The WIDTH samples of a line from number k on: one of their parts, or both. SAMPLE leads to the first. */
#if WIDTH == 1
#define SAMPLE(line, k) ((line) + 2 * (k))
#define LOAD_RE(line, k, pitch) LOAD_PART(SAMPLE(line, k))
#define LOAD_IM(line, k, pitch) LOAD_PART(SAMPLE(line, k) + 1)
#define STORE_RE(value, line, k, pitch) STORE_PART(value, SAMPLE(line, k))
#define STORE_IM(value, line, k, pitch) STORE_PART(value, SAMPLE(line, k) + 1)

INLINE void load_sample(vfloat *re, vfloat *im, __global const sample_t *line, int k, int pitch)
{
    const float2 sample = LOAD_PAIR(SAMPLE(line, k));
    *re = sample.x;
    *im = sample.y;
}

INLINE void store_sample(vfloat re, vfloat im, __global sample_t *line, int k, int pitch)
{
    STORE_PAIR((float2)(re, im), SAMPLE(line, k));
}
#else
#define SAMPLE(line, k) ((line) + (k))
#define LOAD_RE(line, k, pitch) LOAD_PARTS(SAMPLE(line, k))
#define LOAD_IM(line, k, pitch) LOAD_PARTS(SAMPLE(line, k) + (pitch))
#define STORE_RE(value, line, k, pitch) STORE_PARTS(value, SAMPLE(line, k))
#define STORE_IM(value, line, k, pitch) STORE_PARTS(value, SAMPLE(line, k) + (pitch))

INLINE void load_sample(vfloat *re, vfloat *im, __global const sample_t *line, int k, int pitch)
{
    *re = LOAD_RE(line, k, pitch);
    *im = LOAD_IM(line, k, pitch);
}

INLINE void store_sample(vfloat re, vfloat im, __global sample_t *line, int k, int pitch)
{
    STORE_RE(re, line, k, pitch);
    STORE_IM(im, line, k, pitch);
}
#endif
