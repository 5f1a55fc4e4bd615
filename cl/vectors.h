/* Vectors of lanes, in which every kernel computes.
 *
 * A work-item computes WIDTH floats at once: 16, 8 or 4 on a CPU, whose compiler may not vectorise across work-items,
 * and 1 on a GPU. A kernel is written once, in terms of vfloat and vint, for all widths.
 *
 * Products and sums are written a * b + c and left to the compiler to fuse, which it does within an expression only. With
 * some CPU drivers fma(), rint(), clamp() and vloadn() are calls that are not inlined, which costs a factor of two.
 *
 * Build options
 *   WIDTH    lanes of a vector: 1, 4, 8 or 16.
 *   PERMUTE  not 0: define HAS_PICK, pick() and pick_of_two() where the compiler can permute registers.
 */

#ifdef __clang__
#define INLINE static inline __attribute__((always_inline))
#else
#define INLINE static inline
#endif

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)

/* LANES numbers the lanes from 0. LOAD and STORE take a pointer to any float, aligned or not. */
#if WIDTH == 1
typedef float vfloat;
typedef int vint;
#define AS_VINT as_int
#define LOAD(p) (*(p))
#define STORE(value, p) (*(p) = (value))
#define STORE_LOCAL(value, p) (*(p) = (value))
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
typedef float unaligned_vfloat __attribute__((ext_vector_type(WIDTH), aligned(4)));
#define LOAD(p) (*(__global const unaligned_vfloat *)(p))
#define STORE(value, p) (*(__global unaligned_vfloat *)(p) = (value))
#define STORE_LOCAL(value, p) (*(__local unaligned_vfloat *)(p) = (value))
#else
#define LOAD(p) JOIN(vload, WIDTH)(0, p)
#define STORE(value, p) JOIN(vstore, WIDTH)(value, 0, p)
#define STORE_LOCAL(value, p) JOIN(vstore, WIDTH)(value, 0, p)
#endif
#endif

/* One lane of a vector variable, to read or to write. */
#define LANE(vector, number) (((float *)&(vector))[number])
#define INT_LANE(vector, number) (((const int *)&(vector))[number])

/* Adding 1.5 * 2^23 leaves the nearest integer in the low bits of a float's mantissa: rounding and
 * conversion to int in one addition, exact for |x| < 2^22. */
#define ROUNDER 12582912.0f
#define ROUNDED(x) (((x) + ROUNDER) - ROUNDER)
#define INT_OF_SHIFTED(shifted) (as_int(shifted) - 0x4B400000)
#define VINT_OF_SHIFTED(shifted) (AS_VINT(shifted) - 0x4B400000)
#define ROUNDED_INT(x) INT_OF_SHIFTED((x) + ROUNDER)

/* clamp() without a call: a call in an inner loop would spill every register. */
#define CLAMP(x, low, high) ((x) < (low) ? (low) : (x) > (high) ? (high) : (x))

/* AVX: the bits of an x86 processor's registers, where a vector of WIDTH floats fills one. */
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

/* pick() gathers lanes from a vector by index, or from two: 0 to WIDTH - 1 number those of `low`, WIDTH to 2 WIDTH - 1
 * those of `high`. Only an index's lowest bits count, so no index leaves the vectors. */
#if PERMUTE && defined(AVX)
#define HAS_PICK
INLINE vfloat pick(vfloat from, vint index)
{
    const avx_float a = __builtin_astype(from, avx_float);
    const avx_int at = __builtin_astype(index, avx_int);
#if AVX == 512
    return __builtin_astype(__builtin_ia32_permvarsf512(a, at), vfloat);
#else
    return __builtin_astype(__builtin_ia32_permvarsf256(a, at), vfloat);
#endif
}

INLINE vfloat pick_of_two(vfloat low, vfloat high, vint index)
{
#if AVX == 512
    const avx_float a = __builtin_astype(low, avx_float), b = __builtin_astype(high, avx_float);
    return __builtin_astype(__builtin_ia32_vpermi2varps512(a, __builtin_astype(index, avx_int), b), vfloat);
#else
    /* The blend takes each lane by its sign: bit 3 of the index, moved there, chooses between both. */
    return __builtin_astype(__builtin_ia32_blendvps256(__builtin_astype(pick(low, index), avx_float),
                                                       __builtin_astype(pick(high, index), avx_float),
                                                       __builtin_astype(index << 28, avx_float)),
                            vfloat);
#endif
}
#endif
