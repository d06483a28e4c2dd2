// The light step of ptt/ops/relight.py.

#include "lanes.h"

#include <type_traits>
#include <vector>

// light_eigen: U[k, c, x] = sum over l of  L[k, c, l] T[k, l, x]; T is read once, in its own type. L is where a cluster's
// three channels begin, `channel` apart, and those of the next `cluster` further; columns: which l, or all in order.
constexpr int WIDE = 8;    // vectors of x at a time: their sums stay in registers
constexpr int AHEAD = 32;  // rows that are fetched ahead, then those of the next tile
constexpr int LINE = 64;   // bytes that memory gives at a time

template <class Stored>
struct Light {
    const float *lighting;
    const int64_t *columns;
    const Stored *transfer;
    float *out;
    int64_t cluster, channel, rows, width;  // rows: l, width: x

    inline float light(int64_t k, int c, int64_t l) const {
        return lighting[k * cluster + c * channel + (columns ? columns[k * rows + l] : l)];
    }

    template <int N>
    inline void tile(int64_t k, int64_t x) const {
        const Stored *t = transfer + k * rows * width + x;
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
            std::memcpy(padded, transfer + (k * rows + l) * width + x, (width - x) * sizeof(Stored));
            for (int c = 0; c < 3; ++c) sum[c] += light(k, c, l) * load(padded);
        }
        for (int c = 0; c < 3; ++c) std::memcpy(out + (3 * k + c) * width + x, &sum[c], (width - x) * sizeof(float));
    }

    void run(int64_t clusters, int threads) const {
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
    }
};

extern "C" void ptt_light(const float *lighting, const int64_t *columns, const void *transfer, float *out,
                          int64_t cluster, int64_t channel, int64_t rows, int64_t width, int64_t clusters, int type,
                          int threads) {
    const auto run = [=](const auto *stored) {
        Light<std::decay_t<decltype(*stored)>>{lighting, columns, stored, out, cluster, channel, rows, width}.run(
            clusters, threads);
    };
    switch (type) {
        case 0: return run((const float *)transfer);
        case 1: return run((const Half *)transfer);
        case 2: return run((const BFloat *)transfer);
    }
}

// lighting: means of an octahedral map over the cells of a grid, from four samples each, in Haar coefficients.

struct Lighting {
    const float *map, *turn, *directions, *shares;  // map (side * side, 4), directions (4, 3, cells), shares (4, cells)
    int64_t side, cells;

    inline void group(int64_t cell, float *out) const {
        Lanes sum[4] = {};
        for (int q = 0; q < 4; ++q) {
            Lanes world[3], d[3], texel[4];
            for (int c = 0; c < 3; ++c) world[c] = load(directions + (3 * q + c) * cells + cell);
            turned(world, turn, d);
            const Corners on = on_sphere(d, side);
            const Lanes share = load(shares + q * cells + cell);
            for (int j = 0; j < 4; ++j) {
                gather_four(map, on.cell[j] * 4, texel);
                for (int c = 0; c < 3; ++c) sum[c] += share * on.weight[j] * texel[c];
            }
        }
        for (int c = 0; c < 3; ++c) store(out + c * cells + cell, sum[c]);
    }
};

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

// cells: squares * n * n, a multiple of LANES; out (3, squares, n, n)
extern "C" void ptt_lighting(const float *map, const float *turn, const float *directions, const float *shares,
                             float *out, int64_t side, int64_t squares, int64_t n, int threads) {
    const Lighting light{map, turn, directions, shares, side, squares * n * n};
    in_parallel(light.cells / LANES, threads, [&](int64_t i) { light.group(i * LANES, out); });
    in_parallel(3 * squares, threads, [&](int64_t i) {
        std::vector<float> scratch(n * n);
        analyse(out + i * n * n, scratch.data(), n);
    });
}
