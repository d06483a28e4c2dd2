// Vectors of floats as wide as the processor has them, for the kernels of ptt/ops/native.

#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

#include <omp.h>

#include "signatures.h"

#if defined(__AVX512F__)
#include <immintrin.h>
constexpr int LANES = 16;
#elif defined(__AVX__)
#include <immintrin.h>
constexpr int LANES = 8;
#else
constexpr int LANES = 4;
#endif

typedef float Lanes __attribute__((vector_size(4 * LANES)));
typedef int32_t Ints __attribute__((vector_size(4 * LANES)));
typedef float Four __attribute__((vector_size(16)));
typedef float Eight __attribute__((vector_size(32)));
typedef uint16_t Shorts __attribute__((vector_size(2 * LANES)));
typedef int16_t Words __attribute__((vector_size(2 * LANES)));

static inline Lanes all(float x) { return x - Lanes{}; }
static inline Lanes size(Lanes x) { return (Lanes)((Ints)x & 0x7fffffff); }

static inline Lanes load(const float *p) {
    Lanes x;
    std::memcpy(&x, p, sizeof x);
    return x;
}

static inline Lanes load(const BFloat *p) {
    Shorts bits;
    std::memcpy(&bits, p, sizeof bits);
    return (Lanes)(__builtin_convertvector(bits, Ints) << 16);
}

static inline Lanes load(const Half *p) {
#if defined(__AVX512F__)
    return (Lanes)_mm512_cvtph_ps(_mm256_loadu_si256((const __m256i *)p));
#elif defined(__F16C__) && defined(__AVX__)
    return (Lanes)_mm256_cvtph_ps(_mm_loadu_si128((const __m128i *)p));
#else
    Lanes x = {};
    _Float16 h[LANES];
    std::memcpy(h, p, sizeof h);
    for (int l = 0; l < LANES; ++l) x[l] = h[l];
    return x;
#endif
}

static inline Lanes load(const int16_t *p) {
    Words x;
    std::memcpy(&x, p, sizeof x);
    return __builtin_convertvector(__builtin_convertvector(x, Ints), Lanes);
}

static inline void store(float *p, Lanes x) { std::memcpy(p, &x, sizeof x); }

static inline void store(Half *p, Lanes x) {
#if defined(__AVX512F__)
    _mm256_storeu_si256((__m256i *)p, _mm512_cvtps_ph((__m512)x, _MM_FROUND_TO_NEAREST_INT));
#elif defined(__F16C__) && defined(__AVX__)
    _mm_storeu_si128((__m128i *)p, _mm256_cvtps_ph((__m256)x, _MM_FROUND_TO_NEAREST_INT));
#else
    _Float16 h[LANES];
    for (int l = 0; l < LANES; ++l) h[l] = x[l];
    std::memcpy(p, h, sizeof h);
#endif
}

// A group of values, to the nearest whole numbers.
static inline void store_group(int16_t *p, const Lanes *x) {
#if defined(__AVX512F__)
    const Words words = __builtin_convertvector((Ints)_mm512_cvtps_epi32((__m512)*x), Words);
    std::memcpy(p, &words, sizeof words);
#elif defined(__AVX2__)
    const __m256i halves = _mm256_packs_epi32(_mm256_cvtps_epi32((__m256)x[0]), _mm256_cvtps_epi32((__m256)x[1]));
    _mm256_storeu_si256((__m256i *)p, _mm256_permute4x64_epi64(halves, 0xd8));
#else
    for (int l = 0; l < GROUP; ++l) p[l] = (int16_t)std::lrint(x[l / LANES][l % LANES]);
#endif
}

static inline Lanes gather(const float *p, Ints index) {
#if defined(__AVX512F__)
    return _mm512_i32gather_ps((__m512i)index, p, 4);
#elif defined(__AVX2__)
    return (Lanes)_mm256_i32gather_ps(p, (__m256i)index, 4);
#else
    int32_t i[LANES];
    float x[LANES];
    std::memcpy(i, &index, sizeof i);
    for (int l = 0; l < LANES; ++l) x[l] = p[i[l]];
    return load(x);
#endif
}

// ptt.ops.directions.faces_eye, of points from v on.
template <class Points>
static inline Ints faces_eye(const Points &g, int64_t v, Lanes height) {
    return g.distant ? ~Ints{} : (Ints)(height > -load(g.dip + v));
}

// Writes what is sent out at v to the row of the point that lies there, if one does.
template <class Points>
static inline void put_at(const Points &g, int64_t v, Four sent) {
    const uint32_t p = g.point[v];
    if (p < (uint64_t)g.points) std::memcpy(g.out + 3 * p, &sent, 3 * sizeof(float));
}

// The four bytes from each of p's on
static inline Ints gather_bytes(const void *p, Ints index) {
#if defined(__AVX512F__)
    return (Ints)_mm512_i32gather_epi32((__m512i)index, p, 1);
#elif defined(__AVX2__)
    return (Ints)_mm256_i32gather_epi32((const int *)p, (__m256i)index, 1);
#else
    Ints x = {};
    int32_t i[LANES], word[LANES];
    std::memcpy(i, &index, sizeof i);
    for (int l = 0; l < LANES; ++l) std::memcpy(&word[l], (const char *)p + i[l], sizeof *word);
    std::memcpy(&x, word, sizeof x);
    return x;
#endif
}

// x[i] = p[index + i], i < 4
static inline void gather_four(const float *p, Ints index, Lanes *x) {
#if defined(__AVX512F__)
    int32_t i[LANES];
    std::memcpy(i, &index, sizeof i);
    __m512 r[4];
    for (int l = 0; l < 4; ++l) {
        r[l] = _mm512_castps128_ps512(_mm_loadu_ps(p + i[l]));
        r[l] = _mm512_insertf32x4(r[l], _mm_loadu_ps(p + i[4 + l]), 1);
        r[l] = _mm512_insertf32x4(r[l], _mm_loadu_ps(p + i[8 + l]), 2);
        r[l] = _mm512_insertf32x4(r[l], _mm_loadu_ps(p + i[12 + l]), 3);
    }
    const __m512d a = (__m512d)_mm512_unpacklo_ps(r[0], r[1]), b = (__m512d)_mm512_unpackhi_ps(r[0], r[1]);
    const __m512d c = (__m512d)_mm512_unpacklo_ps(r[2], r[3]), d = (__m512d)_mm512_unpackhi_ps(r[2], r[3]);
    x[0] = (Lanes)_mm512_unpacklo_pd(a, c), x[1] = (Lanes)_mm512_unpackhi_pd(a, c);
    x[2] = (Lanes)_mm512_unpacklo_pd(b, d), x[3] = (Lanes)_mm512_unpackhi_pd(b, d);
#elif defined(__AVX__)
    int32_t i[LANES];
    std::memcpy(i, &index, sizeof i);
    __m256 r[4];
    for (int l = 0; l < 4; ++l)
        r[l] = _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(p + i[l])), _mm_loadu_ps(p + i[4 + l]), 1);
    const __m256d a = (__m256d)_mm256_unpacklo_ps(r[0], r[1]), b = (__m256d)_mm256_unpackhi_ps(r[0], r[1]);
    const __m256d c = (__m256d)_mm256_unpacklo_ps(r[2], r[3]), d = (__m256d)_mm256_unpackhi_ps(r[2], r[3]);
    x[0] = (Lanes)_mm256_unpacklo_pd(a, c), x[1] = (Lanes)_mm256_unpackhi_pd(a, c);
    x[2] = (Lanes)_mm256_unpacklo_pd(b, d), x[3] = (Lanes)_mm256_unpackhi_pd(b, d);
#else
    for (int i = 0; i < 4; ++i) x[i] = gather(p + i, index);
#endif
}

// x = the four at p, then the four GAP further on; no store of halves, for which a load of the whole would wait
template <int GAP>
static inline void load_both(const float *p, Eight &x) {
#if defined(__AVX__)
    x = (Eight)(GAP == 4 ? _mm256_loadu_ps(p) : _mm256_loadu2_m128(p + GAP, p));
#else
    std::memcpy(&x, p, sizeof(Four)), std::memcpy((float *)&x + 4, p + GAP, sizeof(Four));
#endif
}

static inline bool any(Ints mask) {
#if defined(__AVX512F__)
    return _mm512_test_epi32_mask((__m512i)mask, (__m512i)mask);
#elif defined(__AVX__)
    return !_mm256_testz_si256((__m256i)mask, (__m256i)mask);
#else
    int32_t m[LANES], all = 0;
    std::memcpy(m, &mask, sizeof m);
    for (int32_t i : m) all |= i;
    return all;
#endif
}

static inline Lanes root(Lanes v) {
#if defined(__AVX512F__)
    return (Lanes)_mm512_sqrt_ps((__m512)v);
#elif defined(__AVX__)
    return (Lanes)_mm256_sqrt_ps((__m256)v);
#else
    float x[LANES];
    std::memcpy(x, &v, sizeof x);
    for (int l = 0; l < LANES; ++l) x[l] = std::sqrt(x[l]);
    return load(x);
#endif
}

static inline Ints lane() {
    Ints i;
    for (int l = 0; l < LANES; ++l) i[l] = l;
    return i;
}
static inline Lanes most(Lanes x, Lanes y) { return x > y ? x : y; }
static inline Lanes least(Lanes x, Lanes y) { return x < y ? x : y; }
static inline float largest(Lanes x) {
    for (int half = LANES / 2; half; half /= 2) x = most(__builtin_shuffle(x, lane() ^ half), x);
    return x[0];
}
// Of each of four vectors.
static inline Four largest_of_four(const Lanes *x) {
#if defined(__AVX512F__)
    const __m512 a = (__m512)x[0], b = (__m512)x[1], c = (__m512)x[2], d = (__m512)x[3];
    const __m512d ab = (__m512d)_mm512_max_ps(_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b));
    const __m512d cd = (__m512d)_mm512_max_ps(_mm512_unpacklo_ps(c, d), _mm512_unpackhi_ps(c, d));
    const __m512 y = _mm512_max_ps((__m512)_mm512_unpacklo_pd(ab, cd), (__m512)_mm512_unpackhi_pd(ab, cd));
    const __m256 z = _mm256_max_ps(_mm512_castps512_ps256(y), (__m256)_mm512_extractf64x4_pd((__m512d)y, 1));
    return (Four)_mm_max_ps(_mm256_castps256_ps128(z), _mm256_extractf128_ps(z, 1));
#elif defined(__AVX__)
    const __m256 a = (__m256)x[0], b = (__m256)x[1], c = (__m256)x[2], d = (__m256)x[3];
    const __m256d ab = (__m256d)_mm256_max_ps(_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b));
    const __m256d cd = (__m256d)_mm256_max_ps(_mm256_unpacklo_ps(c, d), _mm256_unpackhi_ps(c, d));
    const __m256 z = _mm256_max_ps((__m256)_mm256_unpacklo_pd(ab, cd), (__m256)_mm256_unpackhi_pd(ab, cd));
    return (Four)_mm_max_ps(_mm256_castps256_ps128(z), _mm256_extractf128_ps(z, 1));
#else
    return Four{largest(x[0]), largest(x[1]), largest(x[2]), largest(x[3])};
#endif
}
static inline Ints clamp(Ints i, int last) {
    i = i < 0 ? Ints{} : i;
    return i > last ? last - Ints{} : i;
}
static inline Lanes signed_as(Lanes x, Lanes sign) { return (Lanes)((Ints)size(x) | ((Ints)sign & INT32_MIN)); }
static inline Ints whole(Lanes x) { return __builtin_convertvector(x, Ints); }
static inline Lanes real(Ints i) { return __builtin_convertvector(i, Lanes); }

// atan2(s, z) of s, z >= 0: pi / 4 + atan((s - z) / (s + z)), to 1e-7 (Abramowitz and Stegun 4.4.49)
static inline Lanes angle(Lanes s, Lanes z) {
    Lanes t = (s - z) / most(s + z, all(TINY)), u = t * t, p = all(0.0028662257f);
    for (float a : {-0.0161657367f, 0.0429096138f, -0.0752896400f, 0.1065626393f, -0.1420889944f, 0.1999355085f,
                    -0.3333314528f, 1.0f})
        p = p * u + a;
    return p * t + 0.78539816f;
}

// e to the power of x <= 0, to 2e-7
static inline Lanes exponential(Lanes x) {
    const Lanes t = most(x * 1.44269504f, all(-100));
    const Ints i = whole(t - 0.5f);  // the nearest
    const Lanes f = t - real(i);
    Lanes p = all(0.000154035f);
    for (float a : {0.00133335581f, 0.00961812911f, 0.0555041087f, 0.240226507f, 0.693147181f, 1.0f}) p = p * f + a;
    return p * (Lanes)((i + 127) << 23);
}

struct Corners {  // of a bilinear lookup
    Ints cell[4];
    Lanes weight[4];
};

// ptt.ops.octahedral.corners
static inline Corners corners(Lanes a, Lanes b, int n, bool wrap) {
    const float half = 0.5f * n;
    Lanes x = least(most((a + 1.0f) * half - 0.5f, all(-1)), all(n));
    Lanes y = least(most((b + 1.0f) * half - 0.5f, all(-1)), all(n));
    Ints column = whole(x + 1.0f) - 1, row = whole(y + 1.0f) - 1;  // floor
    x -= real(column), y -= real(row);
    Corners at;
    for (int j = 0; j < 4; ++j) {
        Ints r = row + (j >> 1), c = column + (j & 1);
        Ints i = r, k = c;
        if (wrap) {
            k = (r < 0) | (r >= n) ? n - 1 - c : c;
            i = (c < 0) | (c >= n) ? n - 1 - r : r;
        }
        i = clamp(i, n - 1), k = clamp(k, n - 1);
        at.cell[j] = i * n + k;
        at.weight[j] = (j & 1 ? x : 1.0f - x) * (j >> 1 ? y : 1.0f - y);
    }
    return at;
}

struct Place {  // of a bilinear lookup: the first corner, and how far on towards the others
    Ints row, column;
    Lanes x, y;
};

// As `corners` without wrap, n > 1.
static inline Place place(Lanes a, Lanes b, int n) {
    const float half = 0.5f * n;
    Lanes x = least(most((a + 1.0f) * half - 0.5f, all(0)), all(n - 1));
    Lanes y = least(most((b + 1.0f) * half - 0.5f, all(0)), all(n - 1));
    Ints column = clamp(whole(x), n - 2), row = clamp(whole(y), n - 2);
    return {row, column, x - real(column), y - real(row)};
}

// Where a row and a column of the cuts lie, together, in `tiles` of n cells along an edge
static inline Ints in_row(Ints i, int n) { return (i & -TILE) * n + (i & (TILE - 1)) * TILE; }
static inline Ints in_column(Ints i) { return (i & -TILE) * TILE + (i & (TILE - 1)); }

// Of values at the corners, the two of a row next to each other
template <class Value, class Share>
static inline Value blend(const Value *e, Share x, Share y) {
    const Value first = e[0] + x * (e[1] - e[0]), second = e[2] + x * (e[3] - e[2]);
    return first + y * (second - first);
}

// x @ turn
static inline void turned(const Lanes *x, const float *turn, Lanes *out) {
    for (int c = 0; c < 3; ++c) out[c] = x[0] * turn[c] + x[1] * turn[3 + c] + x[2] * turn[6 + c];
}

// a and b of directions of any length (ptt.ops.octahedral.octahedral)
static inline void octahedral(const Lanes *direction, Lanes &a, Lanes &b) {
    Lanes d[3], scale = 1.0f / most(size(direction[0]) + size(direction[1]) + size(direction[2]), all(TINY));
    for (int c = 0; c < 3; ++c) d[c] = direction[c] * scale;
    a = d[2] < 0 ? signed_as(1.0f - size(d[1]), d[0]) : d[0];
    b = d[2] < 0 ? signed_as(1.0f - size(d[0]), d[1]) : d[1];
}

// Corners of directions on an octahedral map of n cells along an edge.
static inline Corners on_sphere(const Lanes *direction, int n) {
    Lanes a, b;
    octahedral(direction, a, b);
    return corners(a, b, n, true);
}

// The same on a map with a border, n cells along an edge with it (ptt.ops.octahedral.bordered).
static inline Place place_on_sphere(const Lanes *direction, int n) {
    Lanes a, b;
    octahedral(direction, a, b);
    const float inner = 1.0f - 2.0f / n;
    return place(a * inner, b * inner, n);
}

constexpr int PARTS_EACH = 16;  // of the work of a thread

// run(first, end) of parts of 0..count-1, within a parallel region: a thread that is done takes the next, since parts
// differ (points may be seen or not), and other programs may hold a thread up. Ends when all are done.
template <class Run>
static inline void by_parts(int64_t count, Run run) {
    const int64_t parts = std::min<int64_t>(count, PARTS_EACH * omp_get_num_threads());
#pragma omp for schedule(dynamic, 1)
    for (int64_t part = 0; part < parts; ++part) run(count * part / parts, count * (part + 1) / parts);
}

// run(i) for i in 0..count-1
template <class Run>
static inline void in_parallel(int64_t count, int threads, Run run) {
#pragma omp parallel num_threads(threads)
    by_parts(count, [&](int64_t first, int64_t end) {
        for (int64_t i = first; i < end; ++i) run(i);
    });
}
