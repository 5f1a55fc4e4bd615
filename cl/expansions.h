/* Expansions of the range over a tile, to third order in pixels from its centre: i along columns, j along rows.
 * expand_tiles finds them, and backproject_tiles evaluates them.
 *
 * expansions: float [tiles][EXPANSION_TERMS][channel_pitch], from each tile's first channel on. Terms 0 to 8 are the
 * coefficients of i, j, i^2, i j, j^2, i^3, i^2 j, i j^2 and j^3 for the difference from the centre's range, samples. With
 * BEAM they are followed by the beam's table coordinate at the centre (beam.h) and its coefficients in the same order.
 */

#include "vectors.h"

#define RANGE_TERMS 9
#if BEAM
#define EXPANSION_TERMS (RANGE_TERMS + 10)
#else
#define EXPANSION_TERMS RANGE_TERMS
#endif

/* One channel's coefficients of i^m j^n. */
typedef struct {
    float i, j, ii, ij, jj, iii, iij, ijj, jjj;
} Coefficients;

INLINE Coefficients coefficients_at(__global const float *term, int channel_pitch)
{
    return (Coefficients){term[0],
                          term[channel_pitch],
                          term[2 * channel_pitch],
                          term[3 * channel_pitch],
                          term[4 * channel_pitch],
                          term[5 * channel_pitch],
                          term[6 * channel_pitch],
                          term[7 * channel_pitch],
                          term[8 * channel_pitch]};
}

/* The coefficients of j^0 to j^3 at i, a scalar or a vector, and the derivatives of the first three along i. */
#define J_0(c, i_) ((i_) * ((c).i + (i_) * ((c).ii + (i_) * (c).iii)))
#define J_1(c, i_) ((c).j + (i_) * ((c).ij + (i_) * (c).iij))
#define J_2(c, i_) ((c).jj + (i_) * (c).ijj)
#define J_3(c) (c).jjj
#define J_0_SLOPE(c, i_) ((c).i + (i_) * (2.0f * (c).ii + (i_) * (3.0f * (c).iii)))
#define J_1_SLOPE(c, i_) ((c).ij + (i_) * (2.0f * (c).iij))
#define J_2_SLOPE(c) (c).ijj

/* A polynomial in j, with coefficients of its own for every lane. */
typedef struct {
    vfloat c0, c1, c2;
    float c3;
} Polynomial;

INLINE Polynomial polynomial_in_j(float at_centre, Coefficients c, vfloat i)
{
    return (Polynomial){at_centre + J_0(c, i), J_1(c, i), J_2(c, i), J_3(c)};
}

INLINE vfloat value_at(const Polynomial *p, vfloat j)
{
    return p->c0 + j * (p->c1 + j * (p->c2 + j * p->c3));
}
