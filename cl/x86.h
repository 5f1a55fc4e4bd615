/* Instructions of x86 processors that compilers do not choose by themselves, called by name.
 *
 * AVX is 512 or 256, the bits of a register, where a vector of WIDTH floats fills one and the compiler knows the
 * instructions; else it is 0, and nothing else is defined here but HAS_PICK.
 *
 * HAS_PICK says whether to use pick() and pick_of_two(), which gather lanes from registers.
 *
 * Build options
 *   PERMUTE  not 0: gather lanes from registers where that is possible.
 */

#include "vectors.h"

#if defined(__clang__) && WIDTH == 16 && defined(__AVX512F__)
#define AVX 512
#elif defined(__clang__) && WIDTH == 8 && defined(__AVX2__) && defined(__F16C__)
#define AVX 256
#else
#define AVX 0
#endif
#define HAS_PICK (PERMUTE && AVX)

#if AVX
typedef float avx_float __attribute__((vector_size(4 * WIDTH)));
typedef int avx_int __attribute__((vector_size(4 * WIDTH)));
typedef short avx_half __attribute__((vector_size(2 * WIDTH)));
#define AVX_FLOAT(v) __builtin_astype(v, avx_float)
#define AVX_INT(v) __builtin_astype(v, avx_int)

/* WIDTH numbers in half precision. PoCL makes two conversions of 8 from vload_half16(), and may call vload_half8(). */
typedef ushort unaligned_halves __attribute__((ext_vector_type(WIDTH), aligned(2)));
#define LOAD_HALVES(p) __builtin_astype(*(__global const unaligned_halves *)(p), avx_half)
#define STORE_HALVES(halves, p) (*(__global unaligned_halves *)(p) = __builtin_astype(halves, unaligned_halves))
#define TO_NEAREST 0

/* pick() gathers lanes from one vector by index, and pick_of_two() from two: indices 0 to WIDTH - 1 are lanes of `low`,
 * WIDTH to 2 WIDTH - 1 those of `high`. The instructions read only the lowest bits of an index, so every index is valid. */
#if AVX == 512
INLINE vfloat pick(vfloat from, vint index)
{
    return __builtin_astype(__builtin_ia32_permvarsf512(AVX_FLOAT(from), AVX_INT(index)), vfloat);
}

INLINE vfloat pick_of_two(vfloat low, vfloat high, vint index)
{
    return __builtin_astype(__builtin_ia32_vpermi2varps512(AVX_FLOAT(low), AVX_INT(index), AVX_FLOAT(high)), vfloat);
}

INLINE vfloat load_halves(__global const half *p)
{
    const avx_float none = AVX_FLOAT((vfloat)0.0f);
    return __builtin_astype(__builtin_ia32_vcvtph2ps512_mask(LOAD_HALVES(p), none, (ushort)-1, 4), vfloat);
}

INLINE void store_halves(vfloat value, __global half *p)
{
    const avx_half none = __builtin_astype((ushort16)0, avx_half);
    STORE_HALVES(__builtin_ia32_vcvtps2ph512_mask(AVX_FLOAT(value), TO_NEAREST, none, (ushort)-1), p);
}
#else
INLINE vfloat pick(vfloat from, vint index)
{
    return __builtin_astype(__builtin_ia32_permvarsf256(AVX_FLOAT(from), AVX_INT(index)), vfloat);
}

INLINE vfloat pick_of_two(vfloat low, vfloat high, vint index)
{
    /* The blend chooses by the sign of each lane, to which the shift moves bit 3 of the index. */
    return __builtin_astype(__builtin_ia32_blendvps256(AVX_FLOAT(pick(low, index)), AVX_FLOAT(pick(high, index)),
                                                       AVX_FLOAT(index << 28)),
                            vfloat);
}

INLINE vfloat load_halves(__global const half *p)
{
    return __builtin_astype(__builtin_ia32_vcvtph2ps256(LOAD_HALVES(p)), vfloat);
}

INLINE void store_halves(vfloat value, __global half *p)
{
    STORE_HALVES(__builtin_ia32_vcvtps2ph256(AVX_FLOAT(value), TO_NEAREST), p);
}
#endif
#endif
