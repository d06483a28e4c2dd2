// The light step of ptt/ops/relight.py.

#include "lanes.h"

#include <vector>

// light_eigen: U[k, c, x] = sum over l of  L[k, c, l] T[k, l, x]; T is read once, in its own type.
constexpr int WIDE = LANES / 2;  // vectors of x at a time: their sums stay in registers
constexpr int AHEAD = 32;  // rows that are fetched ahead, then those of the next tile

template <class Stored>
struct LightOf : LightEigen {
    inline const Stored *stored() const { return (const Stored *)transfer; }

    inline float light(int64_t k, int c, int64_t l) const {
        return lighting[k * cluster + c * channel + (columns ? columns[k * rows + l] : l)];
    }

    template <int N>
    inline void tile(int64_t k, int64_t x) const {
        const Stored *t = stored() + k * rows * width + x;
        Lanes sum[3][N] = {};
        for (int64_t l = 0; l < rows; ++l, t += width) {
            const Stored *later = t + (l + AHEAD < rows ? AHEAD * width : (AHEAD - rows) * width + N * LANES);
            for (int n = 0; n < N; n += LINE / sizeof(Stored) / LANES) __builtin_prefetch(later + n * LANES);
            for (int n = 0; n < N; ++n) {
                const Lanes value = load(t + n * LANES);
                for (int c = 0; c < 3; ++c) sum[c][n] += light(k, c, l) * value;
            }
        }
        for (int c = 0; c < 3; ++c)
            for (int n = 0; n < N; ++n) store(out + (3 * k + c) * width + x + n * LANES, sum[c][n]);
    }

    inline void rest(int64_t k, int64_t x) const {  // the last ones, fewer than a vector's
        Stored padded[LANES] = {};
        Lanes sum[3] = {};
        for (int64_t l = 0; l < rows; ++l) {
            std::memcpy(padded, stored() + (k * rows + l) * width + x, (width - x) * sizeof(Stored));
            for (int c = 0; c < 3; ++c) sum[c] += light(k, c, l) * load(padded);
        }
        for (int c = 0; c < 3; ++c) std::memcpy(out + (3 * k + c) * width + x, &sum[c], (width - x) * sizeof(float));
    }

    Status run() const {
        const int64_t tiles = (width + WIDE * LANES - 1) / (WIDE * LANES);
        in_parallel(clusters * tiles, threads, [&](int64_t i) {
            const int64_t k = i / tiles;
            int64_t x = i % tiles * WIDE * LANES;
            const int64_t end = std::min(x + WIDE * LANES, width);
            if (x + WIDE * LANES == end) return tile<WIDE>(k, x);
            for (; x + 2 * LANES <= end; x += 2 * LANES) tile<2>(k, x);
            for (; x + LANES <= end; x += LANES) tile<1>(k, x);
            if (x < end) rest(k, x);
        });
        return DONE;
    }
};

extern "C" int32_t ptt_light_eigen(const LightEigen *g) {
    switch (g->type) {
        case FLOAT32: return LightOf<float>{*g}.run();
        case FLOAT16: return LightOf<Half>{*g}.run();
        case BFLOAT16: return LightOf<BFloat>{*g}.run();
        default: return UNKNOWN;
    }
}

// lighting: means of an octahedral map over the cells of a grid, from four samples each, in Haar coefficients.

// LANES cells from one on, to out (3, cells)
static inline void means(const Lighting &g, int64_t cells, int64_t cell) {
    Lanes sum[4] = {};
    for (int q = 0; q < 4; ++q) {
        Lanes world[3], d[3], texel[4];
        for (int c = 0; c < 3; ++c) world[c] = load(g.directions + (3 * q + c) * cells + cell);
        turned(world, g.turn, d);
        const Corners on = on_sphere(d, g.side);
        const Lanes share = load(g.shares + q * cells + cell);
        for (int j = 0; j < 4; ++j) {
            gather_four(g.fine, on.cell[j] * 4, texel);
            for (int c = 0; c < 3; ++c) sum[c] += share * on.weight[j] * texel[c];
        }
    }
    for (int c = 0; c < 3; ++c) store(g.out + c * cells + cell, sum[c]);
}

// ptt.ops.haar.analyse of one square of n cells along an edge, in place.
static inline void analyse(float *square, float *scratch, int64_t n) {
    for (int64_t size = n; size > 1; size /= 2) {
        const int64_t h = size / 2;
        for (int64_t i = 0; i < h; ++i) {
            const float *top = square + 2 * i * n, *bottom = top + n;
            float *mean = scratch + i * size, *low = scratch + (h + i) * size;
            for (int64_t j = 0; j < h; ++j) {
                const float a = top[2 * j], b = top[2 * j + 1], c = bottom[2 * j], d = bottom[2 * j + 1];
                mean[j] = (a + b + c + d) / 2, mean[h + j] = (a - b + c - d) / 2;
                low[j] = (a + b - c - d) / 2, low[h + j] = (a - b - c + d) / 2;
            }
        }
        for (int64_t i = 0; i < size; ++i) std::memcpy(square + i * n, scratch + i * size, size * sizeof(float));
    }
}

extern "C" int32_t ptt_lighting(const Lighting *g) {
    const int64_t n = g->n, cells = g->squares * n * n;
    in_parallel(cells / LANES, g->threads, [=](int64_t i) { means(*g, cells, i * LANES); });
    in_parallel(3 * g->squares, g->threads, [=](int64_t i) {
        std::vector<float> scratch(n * n);
        analyse(g->out + i * n * n, scratch.data(), n);
    });
    return DONE;
}
