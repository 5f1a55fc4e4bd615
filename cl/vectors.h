/* Vectors of WIDTH floats, in which every kernel computes.
 *
 * A work-item computes WIDTH floats at once: 16, 8 or 4 on a CPU, whose compiler may not vectorise across work-items,
 * and 1 on a GPU. The elements of a vector are its lanes. Kernels are written once for all widths, in terms of vfloat
 * and vint.
 *
 * Products and sums are written a * b + c, and the compiler fuses them, but only within one expression. With some CPU
 * drivers fma(), rint(), clamp() and vloadn() are function calls that are not inlined, which halves the speed.
 *
 * Build options
 *   WIDTH  lanes of a vector: 1, 4, 8 or 16.
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
#else
typedef JOIN(float, WIDTH) vfloat;
typedef JOIN(int, WIDTH) vint;
#define AS_VINT JOIN(as_int, WIDTH)
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
#define LANES JOIN(LANES_, WIDTH)
#define LANES_1 0.0f
#define LANES_4 ((vfloat)(0, 1, 2, 3))
#define LANES_8 ((vfloat)(0, 1, 2, 3, 4, 5, 6, 7))
#define LANES_16 ((vfloat)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))

/* One lane of a vector variable, to read or to write. */
#define LANE(vector, number) (((float *)&(vector))[number])
#define INT_LANE(vector, number) (((const int *)&(vector))[number])

/* Adding 1.5 * 2^23 leaves the nearest integer in the low bits of a float's mantissa: one addition both rounds and
 * converts to int. It is exact for |x| < 2^22. */
#define ROUNDER 12582912.0f
#define ROUNDED(x) (((x) + ROUNDER) - ROUNDER)
#define INT_OF_SHIFTED(shifted) (as_int(shifted) - 0x4B400000)
#define VINT_OF_SHIFTED(shifted) (AS_VINT(shifted) - 0x4B400000)
#define ROUNDED_INT(x) INT_OF_SHIFTED((x) + ROUNDER)

/* clamp() without a function call, before which the compiler would save every register of an inner loop. */
#define CLAMP(x, low, high) ((x) < (low) ? (low) : (x) > (high) ? (high) : (x))
