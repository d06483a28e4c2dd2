// Shading by triple products (ptt/ops/shade.py): every table is read a row at a time.

#include "lanes.h"

#include <type_traits>

// Products are summed in 16 bits where the processor has such vectors: the tables' rows are scaled so that they fit.
#if defined(__AVX512FP16__)
#define PTT_HALVES 1
#else
#define PTT_HALVES 0
#endif

#if PTT_HALVES
typedef _Float16 Wide __attribute__((vector_size(64)));
static inline __mmask32 first(int64_t left) { return left >= 32 ? ~0u : (1u << left) - 1; }
static inline void load(Wide &x, const Half *p) { x = (Wide)_mm512_loadu_si512(p); }
static inline void load(Wide &x, const Half *p, int64_t left) { x = (Wide)_mm512_maskz_loadu_epi16(first(left), p); }
// bytes as they are: numbers below all normal ones, 2^-24 each, which cost no more than others here
static inline void load(Wide &x, const uint8_t *p) {
    x = (Wide)_mm512_cvtepu8_epi16(_mm256_loadu_si256((const __m256i *)p));
}
static inline void load(Wide &x, const uint8_t *p, int64_t left) {
    x = (Wide)_mm512_cvtepu8_epi16(_mm256_maskz_loadu_epi8(first(left), p));
}
static inline Lanes widened(Wide x) {
    const __m512 low = _mm512_cvtxph_ps(_mm512_castph512_ph256((__m512h)x));
    return (Lanes)_mm512_add_ps(low, _mm512_cvtxph_ps((__m256h)_mm512_extracti64x4_epi64((__m512i)x, 1)));
}
#endif
// What a byte is loaded as, and what weights of bytes sum to, so that their sums are about 1 / 2.
template <class V>
constexpr float LOADED = 1.0f;
template <class V>
constexpr float BYTES = 1.0f / 512;
#if PTT_HALVES
template <>
constexpr float LOADED<Wide> = 1.0f / (1 << 24);
template <>
constexpr float BYTES<Wide> = 1 << 15;
#else
typedef Lanes Wide;
#endif

typedef uint8_t Octets __attribute__((vector_size(LANES)));

static inline Lanes load(const uint8_t *p) {
    Octets x;
    std::memcpy(&x, p, sizeof x);
    return __builtin_convertvector(__builtin_convertvector(x, Ints), Lanes);
}

template <class T>
static inline void load(Lanes &x, const T *p) { x = load(p); }
template <class T>
static inline void load(Lanes &x, const T *p, int64_t left) {
    T some[LANES] = {};
    x = load(left < LANES ? (const T *)std::memcpy(some, p, left * sizeof(T)) : p);
}
static inline Lanes widened(Lanes x) { return x; }
// Keep x, and tell what was kept.
static inline Lanes keep(float *out, Lanes x) { return store(out, x), x; }
static inline Lanes keep(_Float16 *out, Lanes x) { return store((Half *)out, x), load((const Half *)out); }

// The sums of three vectors, to out (4)
static inline void sums_of(const Lanes *x, float *out) {
#if defined(__AVX512F__)
    const __m512 a = (__m512)x[0], b = (__m512)x[1], c = (__m512)x[2], o = _mm512_setzero_ps();
    const __m512d two = (__m512d)_mm512_add_ps(_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b));
    const __m512d one = (__m512d)_mm512_add_ps(_mm512_unpacklo_ps(c, o), _mm512_unpackhi_ps(c, o));
    const __m512 y = _mm512_add_ps((__m512)_mm512_unpacklo_pd(two, one), (__m512)_mm512_unpackhi_pd(two, one));
    const __m256 z = _mm256_add_ps(_mm512_castps512_ps256(y), (__m256)_mm512_extractf64x4_pd((__m512d)y, 1));
    _mm_storeu_ps(out, _mm_add_ps(_mm256_castps256_ps128(z), _mm256_extractf128_ps(z, 1)));
#else
    for (int c = 0; c < 3; ++c) {
        float v[LANES];
        store(v, x[c]);
        out[c] = 0;
        for (int l = 0; l < LANES; ++l) out[c] += v[l];
    }
#endif
}

constexpr int AHEAD = 8;  // points whose visibility is fetched: 4 and 16 were no faster in a trial on the dragon

static inline void fetch(const void *row, int64_t bytes) {
    for (int64_t i = 0; i < bytes; i += LINE) __builtin_prefetch((const char *)row + i);
}

// K rows of a table for each point of a block, mixed by weights times the rows' scale, over their sum, which `gain` holds.
// What 16 bits keep of weights has a sum of its own, which is divided by: results erred by 2e-4 in the mean.
template <class V, class T, int K>
struct Rows {
    typedef typename std::remove_reference<decltype(V{}[0])>::type Number;
    const T *table;
    int64_t width;
    int32_t row[K][LANES];
    Number weight[K][LANES];
    Lanes gain;

    // rows, weights (p, K); of points `at` from the first on; `start` is added to the rows
    void find(const void *from, const float *scale, int64_t size, const int32_t *rows, const float *weights, Ints at,
              Ints start) {
        constexpr float unit = sizeof(T) == 1 ? BYTES<V> : 1.0f, loaded = sizeof(T) == 1 ? LOADED<V> : 1.0f;
        table = (const T *)from, width = size, gain = all(TINY);
        Lanes w[K];
        for (int k = 0; k < K; ++k) {
            const Ints r = (Ints)gather((const float *)rows + k, K * at) + start;
            w[k] = gather(weights + k, K * at);
            if (scale) w[k] *= gather(scale, r);
            gain += w[k];
            std::memcpy(row[k], &r, sizeof r);
        }
        const Lanes by = unit / gain;
        Lanes kept = all(TINY);
        for (int k = 0; k < K; ++k) kept += keep(weight[k], w[k] * by);
        gain /= kept * loaded;
    }
};

// The rows of one point, ready to be read.
template <class V, class T, int K>
struct Mix {
    const T *row[K];
    V weight[K];

    void take(const Rows<V, T, K> &rows, int l) {
        for (int k = 0; k < K; ++k) {
            row[k] = rows.table + rows.row[k][l] * rows.width;
            weight[k] = rows.weight[k][l] - V{};
        }
    }

    template <class... Left>
    V at(int64_t t, Left... left) const {
        V sum, x;
        load(x, row[0] + t, left...), sum = weight[0] * x;
        for (int k = 1; k < K; ++k) load(x, row[k] + t, left...), sum += weight[k] * x;
        return sum;
    }
};

// The sums over triangles for one point: those of Lambert's BRDF, and of I coats, times the light, to out (I + 1, 4). Mixed
// rows hold 32 at most in 16 bits, and 1 / 2 in 8: no sum of ten products leaves 16 bits.
template <class V, class D, int I, class Light, class Glossy, class Seen>
static inline void sum_up(const D *dull, int64_t n, const Light &light, const Glossy *glossy, const Seen &seen, float *out) {
    constexpr int64_t WIDTH = sizeof(V) / sizeof(V{}[0]);
    Lanes total[I + 1][3] = {};
    for (int64_t from = 0; from < n; from += SUMMED_IN_HALVES) {
        V sum[I + 1][3] = {};
        auto add = [&](int64_t t, auto... left) {
            V x;
            const V visible = seen.at(t, left...);
            load(x, dull + t, left...);
            V factor[I + 1] = {x * visible};
            for (int i = 0; i < I; ++i) factor[i + 1] = glossy[i].at(t, left...) * visible;
            for (int c = 0; c < 3; ++c) {
                const V lit = light.at(c * n + t, left...);
                for (int i = 0; i <= I; ++i) sum[i][c] += factor[i] * lit;
            }
        };
        const int64_t end = std::min<int64_t>(from + SUMMED_IN_HALVES, n);
        int64_t t = from;
        for (; t + WIDTH <= end; t += WIDTH) add(t);
        if (t < end) add(t, end - t);
        for (int i = 0; i <= I; ++i)
            for (int c = 0; c < 3; ++c) total[i][c] += widened(sum[i][c]);
    }
    for (int i = 0; i <= I; ++i) sums_of(total[i], out + 4 * i);
}

// A block of points: L frames of light, K directions of view, J rows of visibility, I coats that shine: none, or all.
template <class V, class T, int L, int K, int J, int I>
static void shade(const Shade &g, int64_t p, int count, Ints at, Ints region) {
    typedef typename std::conditional<sizeof(T) == 4, float, Half>::type Dull;
    Rows<V, T, L> lights;
    Rows<V, T, K> views[I ? I : 1];
    Rows<V, uint8_t, J> seen;
    lights.find(g.light, g.light_scale, 3 * g.n, g.light_rows + L * p, g.light_weights + L * p, at, Ints{});
    seen.find(g.visibility, nullptr, g.n, g.seen_rows + J * p, g.seen_weights + J * p, at, Ints{});
    for (int i = 0; i < I; ++i)
        views[i].find(g.glossy, g.glossy_scale, g.n, g.view_rows + K * p, g.view_weights + K * p, at,
                      (Ints)gather((const float *)g.first + i * g.regions, region));
    float sums[LANES][I + 1][4];
    for (int l = 0; l < count; ++l) {
        Mix<V, T, L> light;
        Mix<V, T, K> glossy[I ? I : 1];
        Mix<V, uint8_t, J> visible;
        light.take(lights, l), visible.take(seen, l);
        for (int i = 0; i < I; ++i) glossy[i].take(views[i], l);
        if (p + l + AHEAD < g.points)
            for (int j = 0; j < J; ++j) fetch(g.visibility + g.seen_rows[J * (p + l + AHEAD) + j] * g.n, g.n);
        sum_up<V, Dull, I>((const Dull *)g.dull, g.n, light, glossy, visible, sums[l][0]);
    }
    const Lanes unit = lights.gain * seen.gain * ((float)ROOTS / BYTE / g.n);
    for (int c = 0; c < 3; ++c) {
        Lanes matt = {}, shining = {}, share[2], out;
        for (int i = 0; i < g.coats; ++i) {
            share[i] = gather(g.shares + 3 * (i * g.points + p) + c, 3 * at);
            matt += share[i] * gather(g.diffuse + 3 * i * g.regions + c, 3 * region);
        }
        for (int i = 0; i < I; ++i) {
            const Lanes weight = share[i] * gather(g.specular + 3 * i * g.regions + c, 3 * region);
            shining += weight * views[i].gain * gather(&sums[0][i + 1][c], 4 * (I + 1) * lane());
        }
        const Lanes lamps = g.lamps ? gather(g.lamps + 3 * p + c, 3 * at) : all(0);
        matt *= gather(g.colour + 3 * p + c, 3 * at) * (unit * gather(&sums[0][0][c], 4 * (I + 1) * lane()) + lamps);
        out = matt + unit * shining;
        for (int l = 0; l < count; ++l) g.out[3 * (p + l) + c] = out[l];
    }
}

template <class V, class T, int L, int K, int J>
static void shade_block(const Shade &g, int64_t p, int count) {
    const Ints at = clamp(lane(), count - 1), region = (Ints)gather((const float *)g.region + p, at);
    bool shines = false;
    for (int i = 0; i < g.coats; ++i)
        for (int c = 0; c < 3; ++c)
            for (int l = 0; l < count; ++l) shines |= g.specular[3 * (i * g.regions + region[l]) + c] != 0;
    switch (shines ? g.coats : 0) {
        case 2: return shade<V, T, L, K, J, 2>(g, p, count, at, region);
        case 1: return shade<V, T, L, K, J, 1>(g, p, count, at, region);
        default: return shade<V, T, L, K, J, 0>(g, p, count, at, region);
    }
}

template <class V, class T, int L, int K, int J>
static Status shade_all(const Shade &g) {
    in_parallel((g.points + LANES - 1) / LANES, g.threads, [&](int64_t b) {
        const int64_t p = b * LANES;
        shade_block<V, T, L, K, J>(g, p, (int)std::min<int64_t>(LANES, g.points - p));
    });
    return DONE;
}

template <class V, class T>
static Status shade_typed(const Shade &g) {
    switch (8 * g.lights + g.vertices) {
        case 8 * 1 + 1: return shade_all<V, T, 1, 1, 1>(g);
        case 8 * 4 + 1: return shade_all<V, T, 4, 4, 1>(g);
        case 8 * 4 + 3: return shade_all<V, T, 4, 4, 3>(g);
        case 8 * 4 + 4: return shade_all<V, T, 4, 4, 4>(g);
        case 8 * 8 + 1: return shade_all<V, T, 8, 4, 1>(g);
        case 8 * 8 + 3: return shade_all<V, T, 8, 4, 3>(g);
        case 8 * 8 + 4: return shade_all<V, T, 8, 4, 4>(g);
        default: return UNKNOWN;
    }
}

extern "C" int32_t ptt_shade(const Shade *g) {
    if (g->coats < 1 || g->coats > 2) return UNKNOWN;
    switch (g->type) {
        case FLOAT32: return shade_typed<Lanes, float>(*g);
        case FLOAT16: return shade_typed<Wide, Half>(*g);
        case UINT8: return shade_typed<Wide, uint8_t>(*g);
        default: return UNKNOWN;
    }
}
