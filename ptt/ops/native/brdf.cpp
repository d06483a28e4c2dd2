// The BRDF step of ptt/ops/relight.py.

#include "lanes.h"

#include <vector>

// What a row (x), padded to whole vectors, of an eigen-point is made of.
struct Rows {
    int64_t padded;
    std::vector<float> from_direct;  // (3, factors, padded): what incident factors add
    std::vector<float> from_light;   // (3, HARMONICS, padded): what arriving harmonics add
};

static Rows rows_of(const Exitant &g) {
    const int64_t f = g.factors, o = g.outgoing, padded = (g.x + LANES - 1) / LANES * LANES;
    Rows rows{padded, std::vector<float>(3 * f * padded), std::vector<float>(3 * HARMONICS * padded)};
    for (int64_t c = 0; c < 3; ++c)
        for (int64_t i = 0; i < f; ++i)
            for (int64_t n = 0; n < o; ++n)
                rows.from_direct[(c * f + i) * padded + n] = g.coupling[(c * o + n) * f + i];
    for (int64_t c = 0; c < 3; ++c)
        for (int64_t s = 0; s < HARMONICS; ++s) {
            float *row = rows.from_light.data() + (c * HARMONICS + s) * padded;
            for (int64_t i = 0; i < f; ++i)
                for (int64_t n = 0; n < o; ++n)
                    row[n] += g.to_factors[s * f + i] * rows.from_direct[(c * f + i) * padded + n];
            for (int64_t n = o; n < g.x; ++n) row[n] = g.to_harmonics[s * HARMONICS + n - o];
        }
    return rows;
}

// R eigen-points from v on, of cluster and channel kc, to out (e, x).
template <int R>
static inline void eigen_rows(const Exitant &g, const Rows &rows, int64_t kc, int64_t v, const float *second,
                              float *out) {
    const int64_t c = kc % 3, i = g.factors, first = kc * g.eigen + v, terms = g.slots || g.again ? HARMONICS : 0;
    float light[R][HARMONICS];
    for (int r = 0; r < R; ++r)
        for (int s = 0; s < HARMONICS; s += LANES) {
            Lanes sum = {};
            for (int64_t q = 0; q < g.slots; ++q)
                sum += g.h[3 * q + c] * load(g.one + ((kc * g.slots + q) * g.eigen + v + r) * HARMONICS + s);
            store(light[r] + s, sum);
        }
    for (int r = 0; r < R; ++r) light[r][0] += second[v + r];
    for (int64_t n = 0; n < g.x; n += LANES) {
        Lanes sum[R] = {};
        for (int64_t f = 0; f < i; ++f) {
            const Lanes table = load(rows.from_direct.data() + (c * i + f) * rows.padded + n);
            for (int r = 0; r < R; ++r) sum[r] += g.direct[(first + r) * i + f] * table;
        }
        for (int64_t s = 0; s < terms; ++s) {
            const Lanes table = load(rows.from_light.data() + (c * HARMONICS + s) * rows.padded + n);
            for (int r = 0; r < R; ++r) sum[r] += light[r][s] * table;
        }
        const int64_t size = std::min<int64_t>(LANES, g.x - n) * sizeof(float);
        for (int r = 0; r < R; ++r) std::memcpy(out + (v + r) * g.x + n, &sum[r], size);
    }
}

// The eigen-points of a cluster, A (3, e, x); second: (e), to work with.
static void eigen_points(const Exitant &g, const Rows &rows, int64_t k, float *second, float *out) {
    for (int64_t kc = 3 * k; kc < 3 * k + 3; ++kc, out += g.eigen * g.x) {
        std::fill(second, second + g.eigen, 0.0f);
        for (int64_t p = 0; p < g.again; ++p)
            for (int64_t v = 0; v < g.eigen; ++v)
                second[v] += g.pairs[3 * p + kc % 3] * g.two[(kc * g.again + p) * g.eigen + v];
        int64_t v = 0;
        for (; v + 4 <= g.eigen; v += 4) eigen_rows<4>(g, rows, kc, v, second, out);
        for (; v < g.eigen; ++v) eigen_rows<1>(g, rows, kc, v, second, out);
    }
}

// S[b, c, x, w] unit[b, c, x] = sum over e of  A[cluster[b], c, e, x] W[b, e, w], rounded to 16 bits, and laid out in
// blocks of GROUP points, so that the view step reads it in one line. The row after the last is what rounding took from
// the first.
// Of a tile, in rows x and in vectors of w: 24 sums fill 32 registers, 12 fill 16.
constexpr float FINER = 2 * LARGEST_WORD;  // what rounding takes is half a unit at most
constexpr int ROWS = 6, ACROSS = LANES == 8 ? 2 : 4;

// R rows of a tile; first: the first of all rows is among them. Each row of a group has the unit of its largest sum:
// with that of a bound, the sum of |A| times the largest |W|, rounding was five times as large on the engine, and with
// that of four groups it was a third larger.
template <int R>
static inline void expand_tile(const Exitant &g, const float *a, const float *w, bool first, int16_t *values,
                               float *unit) {
    constexpr int EACH = GROUP / LANES, GROUPS = ACROSS / EACH;
    Lanes sum[R][ACROSS] = {};
    for (int64_t e = 0; e < g.eigen; ++e, a += g.x, w += g.width) {
        Lanes weight[ACROSS];
        for (int n = 0; n < ACROSS; ++n) weight[n] = load(w + n * LANES);
        for (int r = 0; r < R; ++r)
            for (int n = 0; n < ACROSS; ++n) sum[r][n] += a[r] * weight[n];
    }
    Lanes top[R * GROUPS + 3] = {};
    for (int r = 0; r < R; ++r)
        for (int n = 0; n < ACROSS; ++n) {
            Lanes &of_group = top[r * GROUPS + n / EACH];
            of_group = most(size(sum[r][n]), of_group);
        }
    Four own[(R * GROUPS + 3) / 4], scale[(R * GROUPS + 3) / 4];
    for (int i = 0; i < R * GROUPS; i += 4) {
        own[i / 4] = largest_of_four(top + i) * (1.0f / LARGEST_WORD) + TINY;
        scale[i / 4] = 1.0f / own[i / 4];
    }
    const int64_t rows = 3 * (g.x + 1);
    for (int n = 0; n < GROUPS; ++n, unit += rows, values += rows * GROUP)
        for (int r = 0; r < R; ++r) {
            const int i = r * GROUPS + n;
            Lanes scaled[EACH];
            for (int e = 0; e < EACH; ++e) scaled[e] = scale[i / 4][i % 4] * sum[r][n * EACH + e];
            unit[r] = own[i / 4][i % 4];
            store_group(values + r * GROUP, scaled);
            if (r || !first) continue;
            for (int e = 0; e < EACH; ++e) scaled[e] = FINER * (scaled[e] - load(values + e * LANES));
            store_group(values + g.x * GROUP, scaled);
            unit[g.x] = unit[0] / FINER;
        }
}

// By the number of rows.
constexpr decltype(&expand_tile<1>) EXPAND[ROWS] = {expand_tile<1>, expand_tile<2>, expand_tile<3>,
                                                    expand_tile<4>, expand_tile<5>, expand_tile<6>};

// The points of block b, of the eigen-points A (3, e, x) of its cluster.
static inline void expand_block(const Exitant &g, int64_t b, const float *eigen) {
    const int64_t x = g.x, tiles = (x + ROWS - 1) / ROWS;
    const float *w = g.weights + b * g.eigen * g.width;
    for (int64_t c = 0; c < 3; ++c)
        for (int64_t t = 0; t < tiles; ++t) {
            const int64_t first = x * t / tiles, end = x * (t + 1) / tiles;
            const float *a = eigen + c * g.eigen * x + first;
            for (int64_t at = 0; at < g.width; at += ACROSS * LANES) {
                const int64_t row = ((b * g.width + at) / GROUP * 3 + c) * (x + 1) + first;
                EXPAND[end - first - 1](g, a, w + at, t == 0, g.out + row * GROUP, g.unit + row);
            }
        }
}

// Where runs of blocks of one cluster begin, and the end of the last; long ones are shared out among the threads.
static std::vector<int64_t> runs_of(const Exitant &g) {
    const int64_t most = g.blocks / (PARTS_EACH * g.threads) + 1;
    std::vector<int64_t> starts;
    for (int64_t b = 0; b < g.blocks; ++b)
        if (!b || g.cluster[b] != g.cluster[b - 1] || b - starts.back() == most) starts.push_back(b);
    starts.push_back(g.blocks);
    return starts;
}

// Eigen-points are made where the points of their cluster are, and stay in the cache.
extern "C" int32_t ptt_exitant(const Exitant *g) {
    static_assert(WIDTH % (ACROSS * LANES) == 0 && WIDTH % GROUP == 0, "blocks hold whole tiles, and whole groups");
    const Rows rows = rows_of(*g);
    const std::vector<int64_t> starts = runs_of(*g);
    in_parallel(starts.size() - 1, g->threads, [&](int64_t i) {
        std::vector<float> eigen(3 * g->eigen * g->x), second(g->eigen);
        eigen_points(*g, rows, g->cluster[starts[i]], second.data(), eigen.data());
        for (int64_t b = starts[i]; b < starts[i + 1]; ++b) expand_block(*g, b, eigen.data());
    });
    return DONE;
}
