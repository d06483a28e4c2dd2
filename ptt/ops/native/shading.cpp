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

// Of K frames, J rows of visibility and I materials.
template <int K, int J, int I>
static void shade(const Shade &g, int64_t p) {
    const int64_t n = g.n, count = g.points;
    const Half *light[K], *glossy[I];
    const uint8_t *seen[J];
    float share[J];
    for (int k = 0; k < K; ++k) light[k] = g.light + (int64_t)g.frames[k * count + p] * 3 * n;
    for (int i = 0; i < I; ++i) glossy[i] = g.glossy + (int64_t)g.view[i * count + p] * n;
    for (int j = 0; j < J; ++j) {
        seen[j] = g.visibility + (int64_t)g.seen[j * count + p] * n;
        share[j] = g.shares[j * count + p];
    }
    const float *diffuse = g.diffuse + 3 * p;
    Lanes sum[K][3] = {};
    for (int64_t t = 0; t < n; t += LANES) {
        Lanes visible = {}, f[I];
        for (int j = 0; j < J; ++j) visible += share[j] * load(seen[j] + t);
        for (int i = 0; i < I; ++i) f[i] = load(glossy[i] + t);
        const Lanes dull = load(g.dull + t);
        for (int c = 0; c < 3; ++c) {
            Lanes factor = diffuse[c] * dull;
            for (int i = 0; i < I; ++i) factor += g.specular[(i * count + p) * 3 + c] * f[i];
            factor *= visible;
            for (int k = 0; k < K; ++k) sum[k][c] += factor * load(light[k] + c * n + t);
        }
    }
    for (int c = 0; c < 3; ++c) {
        Lanes all = {};
        for (int k = 0; k < K; ++k) all += g.weights[k * count + p] * sum[k][c];
        g.out[3 * p + c] = g.unit * sum_of(all);
    }
}

template <int K, int J>
static inline void of_materials(const Shade &g, int64_t p) {
    switch (g.materials) {
        case 1: return shade<K, J, 1>(g, p);
        case 2: return shade<K, J, 2>(g, p);
    }
}

template <int K>
static inline void of_visibility(const Shade &g, int64_t p) {
    switch (g.vertices) {
        case 1: return of_materials<K, 1>(g, p);
        case 3: return of_materials<K, 3>(g, p);
        case 4: return of_materials<K, 4>(g, p);
    }
}

extern "C" void ptt_shade(const Shade *g) {
    constexpr int64_t BLOCK = 64;
    in_parallel((g->points + BLOCK - 1) / BLOCK, g->threads, [=](int64_t b) {
        for (int64_t p = b * BLOCK; p < std::min((b + 1) * BLOCK, g->points); ++p) {
            if (g->lights == 1) of_visibility<1>(*g, p);
            else if (g->lights == 4) of_visibility<4>(*g, p);
            else of_visibility<8>(*g, p);
        }
    });
}
