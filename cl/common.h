/* Types and helpers shared by every kernel.
 *
 * WIDTH (build option) is the number of float lanes a work-item computes at once: 16, 8 or 4 on a
 * CPU, whose compiler may not vectorise across work-items, and 1 on a GPU. A kernel is written once
 * for all widths in terms of vfloat and vint.
 *
 * Products and sums are written a * b + c and left to the compiler to fuse: with some CPU drivers
 * fma(), rint() and vloadn() are calls that are not inlined, which costs a factor of two.
 */

#ifdef __clang__
#define INLINE static inline __attribute__((always_inline))
#else
#define INLINE static inline
#endif

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)

#if WIDTH == 1
typedef float vfloat;
typedef int vint;
#define AS_VINT as_int
#define LOAD(p) (*(p))
#define STORE(value, p) (*(p) = (value))
#define LANES 0.0f
#else
typedef JOIN(float, WIDTH) vfloat;
typedef JOIN(int, WIDTH) vint;
#define AS_VINT JOIN(as_int, WIDTH)
#if WIDTH == 16
#define LANES ((vfloat)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))
#elif WIDTH == 8
#define LANES ((vfloat)(0, 1, 2, 3, 4, 5, 6, 7))
#else
#define LANES ((vfloat)(0, 1, 2, 3))
#endif
#ifdef __clang__
typedef float vfloat_anywhere __attribute__((ext_vector_type(WIDTH), aligned(4)));
#define LOAD(p) (*(__global const vfloat_anywhere *)(p))
#define STORE(value, p) (*(__global vfloat_anywhere *)(p) = (value))
#else
#define LOAD(p) JOIN(vload, WIDTH)(0, p)
#define STORE(value, p) JOIN(vstore, WIDTH)(value, 0, p)
#endif
#endif

/* Adding 1.5 * 2^23 leaves the nearest integer in the low bits of a float's mantissa: rounding and
 * conversion to int in one addition, exact for |x| < 2^22. */
#define ROUNDER 12582912.0f
#define ROUNDED_INT(shifted) (as_int(shifted) - 0x4B400000)
#define ROUNDED_VINT(shifted) (AS_VINT(shifted) - 0x4B400000)

/* sin and cos of 2 pi t for t in cycles, |t| < 2^22. Error below 1.3e-6: least-squares polynomials
 * with equalised error over one reduced cycle, in place of sin() and cos(), which are scalar code on some
 * CPU drivers and take radians, whose reduction loses bits. */
INLINE void sincos_cycles(vfloat t, vfloat *sine, vfloat *cosine)
{
    const vfloat nearest = (t + ROUNDER) - ROUNDER;
    const vfloat r = t - nearest;
    const vfloat z = r * r;
    vfloat s = z * -12.2712614f + 41.2053942f;
    s = s * z - 76.5801004f;
    s = s * z + 81.5961839f;
    s = s * z - 41.3414214f;
    s = s * z + 6.28318282f;
    *sine = s * r;
    vfloat c = z * -21.0767793f + 58.794037f;
    c = c * z - 85.2723966f;
    c = c * z + 64.9287266f;
    c = c * z - 19.7389825f;
    *cosine = c * z + 0.999999222f;
}

/* The weights of an interpolation by an even number of taps, a constant, at nu in [-0.5, 0.5] from their middle: the
 * one at +-(pair + 0.5) has E(nu^2) +- nu O(nu^2). filter: float [taps / 2][2][taps / 2], per pair from
 * the innermost the coefficients of E, then O, highest power first. */
INLINE void filter_weights(__global const float *filter, const int taps, vfloat nu, vfloat *weight)
{
    const vfloat square = nu * nu;
#pragma unroll
    for (int pair = 0; pair < taps / 2; pair++) {
        vfloat even = filter[pair * taps], odd = filter[pair * taps + taps / 2];
#pragma unroll
        for (int power = 1; power < taps / 2; power++) {
            even = even * square + filter[pair * taps + power];
            odd = odd * square + filter[pair * taps + taps / 2 + power];
        }
        weight[taps / 2 + pair] = even + nu * odd;
        weight[taps / 2 - 1 - pair] = even - nu * odd;
    }
}

/* clamp() that is no call: one in an inner loop would spill every register. */
#define KEEP(x, low, high) ((x) < (low) ? (low) : (x) > (high) ? (high) : (x))

/* Where vectors of WIDTH floats are registers of an x86 processor: their bits. */
#if defined(__clang__) && WIDTH == 16 && defined(__AVX512F__)
#define AVX 512
#elif defined(__clang__) && WIDTH == 8 && defined(__AVX2__) && defined(__F16C__)
#define AVX 256
#endif
#ifdef AVX
typedef float avx_float __attribute__((vector_size(4 * WIDTH)));
typedef int avx_int __attribute__((vector_size(4 * WIDTH)));
typedef short avx_half __attribute__((vector_size(2 * WIDTH)));
#endif

/* With the build option PERMUTE, where the compiler can: the elements of two vectors by their indices, of which only
 * the lowest bits count that number them. */
#if PERMUTE && defined(AVX)
#define WINDOW
INLINE vfloat PICK(vfloat low, vfloat high, vint index)
{
    const avx_float a = __builtin_astype(low, avx_float), b = __builtin_astype(high, avx_float);
    const avx_int at = __builtin_astype(index, avx_int);
#if AVX == 512
    return __builtin_astype(__builtin_ia32_vpermi2varps512(a, at, b), vfloat);
#else
    /* The sign of the last says of which of the two. */
    return __builtin_astype(__builtin_ia32_blendvps256(__builtin_ia32_permvarsf256(a, at),
                                                       __builtin_ia32_permvarsf256(b, at), (avx_float)(at << 28)),
                            vfloat);
#endif
}
#endif

/* The samples of lines as kernels hand them on: `held` is float or, with the build option HALF, half, which takes
 * half of the memory and errs by -74 dB. Whatever they are held as, sums are of floats. */
#if !HALF
typedef float held;
#define LOAD_HELD(p) LOAD(p)
#define STORE_HELD(value, p) STORE(value, p)
#define ONE_HELD(p) (*(p))
#define PAIR_HELD(p) (*(__global const float2 *)(p))
#else
typedef half held;
#define ONE_HELD(p) vload_half(0, p)
#define PAIR_HELD(p) vload_half2(0, p)
#if WIDTH == 1
#define LOAD_HELD(p) vload_half(0, p)
#define STORE_HELD(value, p) vstore_half(value, 0, p)
#elif defined(AVX)
/* vload_half16() is two conversions of 8 here, and vload_half8() may be a call. */
typedef ushort half_anywhere __attribute__((ext_vector_type(WIDTH), aligned(2)));
#define TO_NEAREST 0
INLINE vfloat LOAD_HELD(__global const half *p)
{
    const avx_half halves = __builtin_astype(*(__global const half_anywhere *)p, avx_half);
#if AVX == 512
    const avx_float none = __builtin_astype((vfloat)0.0f, avx_float);
    return __builtin_astype(__builtin_ia32_vcvtph2ps512_mask(halves, none, (ushort)-1, 4), vfloat);
#else
    return __builtin_astype(__builtin_ia32_vcvtph2ps256(halves), vfloat);
#endif
}
INLINE void STORE_HELD(vfloat value, __global half *p)
{
    const avx_float floats = __builtin_astype(value, avx_float);
#if AVX == 512
    const avx_half none = __builtin_astype((ushort16)0, avx_half);
    const avx_half halves = __builtin_ia32_vcvtps2ph512_mask(floats, TO_NEAREST, none, (ushort)-1);
#else
    const avx_half halves = __builtin_ia32_vcvtps2ph256(floats, TO_NEAREST);
#endif
    *(__global half_anywhere *)p = __builtin_astype(halves, half_anywhere);
}
#else
#define LOAD_HELD(p) JOIN(vload_half, WIDTH)(0, p)
#define STORE_HELD(value, p) JOIN(vstore_half, WIDTH)((vfloat)(value), 0, p)
#endif
#endif
