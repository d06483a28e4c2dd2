// The light step of ptt/ops/relight.py.

#include "lanes.h"

#include <vector>

// light_eigen: U[k, c, x] = sum over l of  L[k, c, l] T[k, l, x]; T is read once, in its own type.
// Rows are read as they lie in memory, and their sums are kept in the nearest cache: with sums in registers and rows in
// pieces of 256 bytes, the engine's T1 was read at 18 GB/s for 25 (of 31).
constexpr int ACROSS = 1024;  // values of x at a time: 512 were a fifth slower in a trial, 2560 no faster
constexpr int TOGETHER = 4;   // rows at a time, whose 12 lights stay in registers; 8 were a tenth slower
constexpr int AHEAD = 4;      // rows that are fetched ahead: 8, 16 and 32 were slower

template <class Stored>
struct LightOf : LightEigen {
    inline const Stored *stored() const { return (const Stored *)transfer; }

    // Adds R rows from l on, lit by light (rows, 3), to `count` sums from x on.
    template <int R>
    inline void add(const float *light, int64_t k, int64_t l, int64_t x, int64_t count) const {
        const Stored *t = stored() + (k * rows + l) * width + x;
        const Stored *later = t + std::min<int64_t>(AHEAD, rows - R - l) * width;
        float *sums = out + 3 * k * width + x;
        Lanes lit[R][3];
        for (int r = 0; r < R; ++r)
            for (int c = 0; c < 3; ++c) lit[r][c] = all(light[3 * (l + r) + c]);
        const auto add_at = [=](int64_t i) {
            Lanes sum[3];
            for (int c = 0; c < 3; ++c) sum[c] = load(sums + c * width + i);
            for (int r = 0; r < R; ++r) {
                const Lanes value = load(t + r * width + i);
                for (int c = 0; c < 3; ++c) sum[c] += lit[r][c] * value;
            }
            for (int c = 0; c < 3; ++c) store(sums + c * width + i, sum[c]);
        };
        constexpr int EACH = LINE / sizeof(Stored);
        int64_t i = 0;
        for (; i + EACH <= count; i += EACH) {
            for (int r = 0; r < R; ++r) __builtin_prefetch(later + r * width + i);
            for (int n = 0; n < EACH; n += LANES) add_at(i + n);
        }
        for (; i < count; i += LANES) add_at(i);
    }

    inline void rest(const float *light, int64_t k, int64_t x) const {  // the last ones, fewer than a vector's
        Stored padded[LANES] = {};
        Lanes sum[3] = {};
        for (int64_t l = 0; l < rows; ++l) {
            std::memcpy(padded, stored() + (k * rows + l) * width + x, (width - x) * sizeof(Stored));
            for (int c = 0; c < 3; ++c) sum[c] += light[3 * l + c] * load(padded);
        }
        for (int c = 0; c < 3; ++c) std::memcpy(out + (3 * k + c) * width + x, &sum[c], (width - x) * sizeof(float));
    }

    Status run() const {
        const int64_t tiles = (width + ACROSS - 1) / ACROSS;
        in_parallel(clusters * tiles, threads, [&](int64_t i) {
            const int64_t k = i / tiles, tile = i % tiles, vectors = width / LANES;
            const int64_t x = vectors * tile / tiles * LANES, end = vectors * (tile + 1) / tiles * LANES;
            std::vector<float> light(3 * rows);
            for (int64_t l = 0; l < rows; ++l)
                for (int c = 0; c < 3; ++c)
                    light[3 * l + c] = lighting[k * cluster + c * channel + (columns ? columns[k * rows + l] : l)];
            for (int c = 0; c < 3; ++c) std::fill_n(out + (3 * k + c) * width + x, end - x, 0.0f);
            int64_t l = 0;
            for (; l + TOGETHER <= rows; l += TOGETHER) add<TOGETHER>(light.data(), k, l, x, end - x);
            for (; l < rows; ++l) add<1>(light.data(), k, l, x, end - x);
            if (tile == tiles - 1 && end < width) rest(light.data(), k, end);
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
