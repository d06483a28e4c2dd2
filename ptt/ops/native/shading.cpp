// Shading by triple products (ptt/ops/shade.py): every table is read a row at a time, 16 triangles at once.

#include "lanes.h"

typedef uint8_t Bytes __attribute__((vector_size(LANES)));

static inline Lanes load(const uint8_t *p) {
#if defined(__AVX512F__)
    return (Lanes)_mm512_cvtepi32_ps(_mm512_cvtepu8_epi32(_mm_loadu_si128((const __m128i *)p)));
#endif
    Bytes x;
    std::memcpy(&x, p, sizeof x);
    return __builtin_convertvector(__builtin_convertvector(x, Ints), Lanes);
}

static inline float sum_of(Lanes x) {
#if defined(__AVX512F__)
    return _mm512_reduce_add_ps((__m512)x);
#endif
    float v[LANES], sum = 0;
    store(v, x);
    for (int l = 0; l < LANES; ++l) sum += v[l];
    return sum;
}

// As shading.py lays it out: light (f, 3, n), visibility (v, n), dull (n), glossy (o, n); frames and weights (k, p), seen
// and shares (j, p), view (i, p), specular (i, p, 3), diffuse (p, 3), out (p, 3). n is a multiple of 16.
struct Shade {
    const Half *light;
    const uint8_t *visibility;
    const float *dull;
    const Half *glossy;
    const int32_t *frames, *seen, *view;
    const float *weights, *shares, *specular, *diffuse;
    float *out;
    int64_t points, n;
    float unit;  // 20 / n, and of the light and of the bytes
    int32_t lights, vertices, materials, threads;
};

constexpr int AHEAD = 8;  // points whose visibility is fetched
constexpr int LINE = 64;  // bytes that memory gives at a time

static inline void fetch(const uint8_t *row, int64_t bytes) {
    for (int64_t i = 0; i < bytes; i += LINE) __builtin_prefetch(row + i);
}

// Of R points from p on that have the same K frames, so that their light is read once; J rows of visibility, I materials.
template <int R, int K, int J, int I>
static void shade(const Shade &g, int64_t p) {
    const int64_t n = g.n, count = g.points;
    const Half *light[K], *glossy[R][I];
    const uint8_t *seen[R][J];
    for (int k = 0; k < K; ++k) light[k] = g.light + (int64_t)g.frames[k * count + p] * 3 * n;
    for (int r = 0; r < R; ++r) {
        for (int i = 0; i < I; ++i) glossy[r][i] = g.glossy + (int64_t)g.view[i * count + p + r] * n;
        for (int j = 0; j < J; ++j) seen[r][j] = g.visibility + (int64_t)g.seen[j * count + p + r] * n;
    }
    Lanes sum[R][K][3] = {};
    for (int64_t t = 0; t < n; t += LANES) {
        const Lanes dull = load(g.dull + t);
        Lanes factor[R][3];
        for (int r = 0; r < R; ++r) {
            Lanes visible = {};
            for (int j = 0; j < J; ++j) visible += g.shares[j * count + p + r] * load(seen[r][j] + t);
            for (int c = 0; c < 3; ++c) factor[r][c] = g.diffuse[3 * (p + r) + c] * dull;
            for (int i = 0; i < I; ++i) {
                const Lanes f = load(glossy[r][i] + t);
                for (int c = 0; c < 3; ++c) factor[r][c] += g.specular[(i * count + p + r) * 3 + c] * f;
            }
            for (int c = 0; c < 3; ++c) factor[r][c] *= visible;
        }
        for (int k = 0; k < K; ++k)
            for (int c = 0; c < 3; ++c) {
                const Lanes value = load(light[k] + c * n + t);
                for (int r = 0; r < R; ++r) sum[r][k][c] += factor[r][c] * value;
            }
    }
    for (int r = 0; r < R; ++r)
        for (int c = 0; c < 3; ++c) {
            Lanes all = {};
            for (int k = 0; k < K; ++k) all += g.weights[k * count + p + r] * sum[r][k][c];
            g.out[3 * (p + r) + c] = g.unit * sum_of(all);
        }
}

// Points first..end-1, two at a time where their frames agree.
template <int K, int J, int I>
static void shade_all(const Shade &g, int64_t first, int64_t end) {
    for (int64_t p = first; p < end;) {
        for (int64_t later = p + AHEAD; later < std::min(p + AHEAD + 2, g.points); ++later)
            for (int j = 0; j < J; ++j) fetch(g.visibility + (int64_t)g.seen[j * g.points + later] * g.n, g.n);
        bool alike = K <= 4 && p + 1 < end;  // for eight there are not enough registers
        for (int k = 0; k < K && alike; ++k) alike = g.frames[k * g.points + p] == g.frames[k * g.points + p + 1];
        if (alike) shade<2, K, J, I>(g, p), p += 2;
        else shade<1, K, J, I>(g, p), ++p;
    }
}

template <int K, int J>
static inline void of_materials(const Shade &g, int64_t first, int64_t end) {
    switch (g.materials) {
        case 1: return shade_all<K, J, 1>(g, first, end);
        case 2: return shade_all<K, J, 2>(g, first, end);
    }
}

template <int K>
static inline void of_visibility(const Shade &g, int64_t first, int64_t end) {
    switch (g.vertices) {
        case 1: return of_materials<K, 1>(g, first, end);
        case 3: return of_materials<K, 3>(g, first, end);
        case 4: return of_materials<K, 4>(g, first, end);
    }
}

extern "C" void ptt_shade(const Shade *g) {
    constexpr int64_t BLOCK = 64;
    in_parallel((g->points + BLOCK - 1) / BLOCK, g->threads, [=](int64_t b) {
        const int64_t first = b * BLOCK, end = std::min(first + BLOCK, g->points);
        switch (g->lights) {
            case 1: return of_visibility<1>(*g, first, end);
            case 4: return of_visibility<4>(*g, first, end);
            case 8: return of_visibility<8>(*g, first, end);
        }
    });
}
