/* The samples of range lines, as kernels pass them to one another.
 *
 * A line is `pitch` complex samples. With WIDTH > 1 its real parts come first, then its imaginary parts,
 * [lines][2][pitch]; with WIDTH 1 they are interleaved, [lines][pitch][2]. Kernels compute in float whatever the samples
 * are stored as.
 *
 * Build options
 *   HALF  1: a sample's parts are stored as half, which takes half of the memory and errs by -74 dB; 0: as float.
 */

#include "vectors.h"

/* sample_t stores one real or imaginary part. LOAD_PARTS and STORE_PARTS move WIDTH consecutive ones, LOAD_PAIR and
 * STORE_PAIR both parts of an interleaved sample. */
#if !HALF
typedef float sample_t;
#define LOAD_PARTS(p) LOAD(p)
#define STORE_PARTS(value, p) STORE(value, p)
#define LOAD_PART(p) (*(p))
#define LOAD_PAIR(p) (*(__global const float2 *)(p))
#define STORE_PAIR(value, p) (*(__global float2 *)(p) = (value))
#else
typedef half sample_t;
#define LOAD_PART(p) vload_half(0, p)
#define LOAD_PAIR(p) vload_half2(0, p)
#define STORE_PAIR(value, p) vstore_half2(value, 0, p)
#if WIDTH == 1
#define LOAD_PARTS(p) vload_half(0, p)
#define STORE_PARTS(value, p) vstore_half(value, 0, p)
#elif defined(AVX)
/* Instructions by name, because PoCL makes two conversions of 8 from vload_half16() and may call vload_half8(). */
typedef ushort unaligned_halves __attribute__((ext_vector_type(WIDTH), aligned(2)));
#define TO_NEAREST 0
INLINE vfloat LOAD_PARTS(__global const half *p)
{
    const avx_half halves = __builtin_astype(*(__global const unaligned_halves *)p, avx_half);
#if AVX == 512
    const avx_float none = __builtin_astype((vfloat)0.0f, avx_float);
    return __builtin_astype(__builtin_ia32_vcvtph2ps512_mask(halves, none, (ushort)-1, 4), vfloat);
#else
    return __builtin_astype(__builtin_ia32_vcvtph2ps256(halves), vfloat);
#endif
}
INLINE void STORE_PARTS(vfloat value, __global half *p)
{
    const avx_float floats = __builtin_astype(value, avx_float);
#if AVX == 512
    const avx_half none = __builtin_astype((ushort16)0, avx_half);
    const avx_half halves = __builtin_ia32_vcvtps2ph512_mask(floats, TO_NEAREST, none, (ushort)-1);
#else
    const avx_half halves = __builtin_ia32_vcvtps2ph256(floats, TO_NEAREST);
#endif
    *(__global unaligned_halves *)p = __builtin_astype(halves, unaligned_halves);
}
#else
#define LOAD_PARTS(p) JOIN(vload_half, WIDTH)(0, p)
#define STORE_PARTS(value, p) JOIN(vstore_half, WIDTH)((vfloat)(value), 0, p)
#endif
#endif

/* Line `number` of lines. */
#define LINE(lines, number, pitch) ((lines) + (size_t)(number) * 2 * (pitch))

/* Real and imaginary parts of the WIDTH samples of a line from number k on. */
#if WIDTH == 1
#define LOAD_RE(line, k, pitch) LOAD_PARTS((line) + 2 * (k))
#define LOAD_IM(line, k, pitch) LOAD_PARTS((line) + 2 * (k) + 1)
#define STORE_RE(value, line, k, pitch) STORE_PARTS(value, (line) + 2 * (k))
#define STORE_IM(value, line, k, pitch) STORE_PARTS(value, (line) + 2 * (k) + 1)
#else
#define LOAD_RE(line, k, pitch) LOAD_PARTS((line) + (k))
#define LOAD_IM(line, k, pitch) LOAD_PARTS((line) + (k) + (pitch))
#define STORE_RE(value, line, k, pitch) STORE_PARTS(value, (line) + (k))
#define STORE_IM(value, line, k, pitch) STORE_PARTS(value, (line) + (k) + (pitch))
#endif

/* The same of both parts. */
INLINE void load_sample(vfloat *re, vfloat *im, __global const sample_t *line, int k, int pitch)
{
#if WIDTH == 1
    const float2 sample = LOAD_PAIR(line + 2 * k);
    *re = sample.x;
    *im = sample.y;
#else
    *re = LOAD_RE(line, k, pitch);
    *im = LOAD_IM(line, k, pitch);
#endif
}

INLINE void store_sample(vfloat re, vfloat im, __global sample_t *line, int k, int pitch)
{
#if WIDTH == 1
    STORE_PAIR((float2)(re, im), line + 2 * k);
#else
    STORE_RE(re, line, k, pitch);
    STORE_IM(im, line, k, pitch);
#endif
}
