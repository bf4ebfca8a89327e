/* WIDTH doubles in one vector, and masks that choose some of them: AVX-512 with its mask registers where the processor
   has it, otherwise the vector extensions of GCC and Clang at the width of AVX. */

#include <math.h>
#include <stdint.h>

#ifdef __AVX512DQ__

#include <immintrin.h>

#define WIDTH 8
typedef __m512d Lanes;
typedef __mmask8 Mask;

static inline Lanes all(double a) { return _mm512_set1_pd(a); }
static inline Lanes choose(Mask m, Lanes a, Lanes b) { return _mm512_mask_blend_pd(m, b, a); }
static inline Lanes larger(Lanes a, Lanes b) { return _mm512_max_pd(a, b); }
static inline Lanes smaller(Lanes a, Lanes b) { return _mm512_min_pd(a, b); }
static inline Lanes absolute(Lanes a) { return _mm512_abs_pd(a); }
static inline Mask below(Lanes a, Lanes b) { return _mm512_cmp_pd_mask(a, b, _CMP_LT_OQ); }
static inline Mask at_most(Lanes a, Lanes b) { return _mm512_cmp_pd_mask(a, b, _CMP_LE_OQ); }
static inline Mask every(void) { return 0xff; }
static inline Mask none(void) { return 0; }
static inline int any(Mask m) { return m != 0; }
static inline int chosen(Mask m, int lane) { return m >> lane & 1; }

#else

#define WIDTH 4
typedef double Lanes __attribute__((vector_size(8 * WIDTH)));
typedef int64_t Mask __attribute__((vector_size(8 * WIDTH))); /* all bits of a lane set, or none */

static inline Lanes all(double a) { return a - (Lanes){0}; }
static inline Lanes choose(Mask m, Lanes a, Lanes b) { return (Lanes)((m & (Mask)a) | (~m & (Mask)b)); }
static inline Lanes larger(Lanes a, Lanes b) { return choose(a > b, a, b); }
static inline Lanes smaller(Lanes a, Lanes b) { return choose(a < b, a, b); }
static inline Lanes absolute(Lanes a) { return (Lanes)((Mask)a & INT64_MAX); }
static inline Mask below(Lanes a, Lanes b) { return a < b; }
static inline Mask at_most(Lanes a, Lanes b) { return a <= b; }
static inline Mask every(void) { return ~(Mask){0}; }
static inline Mask none(void) { return (Mask){0}; }
static inline int any(Mask m) { return (m[0] | m[1] | m[2] | m[3]) != 0; }
static inline int chosen(Mask m, int lane) { return m[lane] != 0; }

#endif

static inline Mask finite_lanes(Lanes a) { return below(absolute(a), all(INFINITY)); }
static inline Lanes one_in(Mask m) { return choose(m, all(1.0), all(0.0)); }
