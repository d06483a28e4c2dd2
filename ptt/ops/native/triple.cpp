// Integrals of products of three sparse functions (ptt/ops/triple.py), down the tree only where coefficients are.

#include "lanes.h"

#include <vector>

// A function of every point: indices, values (p, count), of n coefficients, ROOTS of them roots.
struct Sparse {
    const int32_t *indices;
    const float *values;
    int64_t count;
};

// What one thread keeps: dense coefficients (n, 3), one after the other those of a node; nodes that hold some below them.
struct Scratch {
    std::vector<float> value;
    std::vector<uint8_t> active;
    std::vector<int32_t> nodes;

    explicit Scratch(int64_t n) : value(3 * n), active(n / 3 + 1) {}

    // The triangle, counted through all levels, whose wavelet a coefficient is: three each, after the roots.
    static int32_t node(int32_t index, int32_t &level_start) {
        level_start = 0;
        int32_t size = ROOTS, first = ROOTS;
        while (index >= 4 * first) level_start += size, size *= 4, first *= 4;
        return level_start + (index - first) / 3;
    }

    void put(const Sparse &s, int64_t p, int function) {
        for (int64_t k = s.count * p; k < s.count * (p + 1); ++k) {
            const int32_t index = s.indices[k];
            value[3 * index + function] = s.values[k];
            if (index < ROOTS) continue;
            int32_t start, at = node(index, start), i = at - start;
            for (; !active[at]; i /= 4) {
                active[at] = 1, nodes.push_back(at);
                if (start == 0) break;
                start = (start - ROOTS) / 4, at = start + i / 4;
            }
        }
    }

    void clear(const Sparse *s, int64_t p) {
        for (int f = 0; f < 3; ++f)
            for (int64_t k = s[f].count * p; k < s[f].count * (p + 1); ++k) value[3 * s[f].indices[k] + f] = 0;
        for (int32_t at : nodes) active[at] = 0;
        nodes.clear();
    }
};

// Of triangle i of a level, whose nodes start there, with the means f, g, h of the three functions.
static float below(const Scratch &s, int32_t start, int32_t size, int32_t i, const float *mean, float area) {
    if (start + i >= (int32_t)s.active.size() - 1 || !s.active[start + i]) return 0;
    static const float SIGNS[3][4] = {{1, -1, -1, 1}, {1, -1, 1, -1}, {1, 1, -1, -1}};
    const float *d = s.value.data() + 3 * (size + 3 * i);  // size: also the level's first coefficient
    float sum = 0, f[3], g[3], h[3], child[4][3];
    for (int t = 0; t < 3; ++t) {
        f[t] = d[3 * t], g[t] = d[3 * t + 1], h[t] = d[3 * t + 2];
        sum += f[t] * g[t] * mean[2] + f[t] * h[t] * mean[1] + g[t] * h[t] * mean[0];
    }
    for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b)
            if (a != b) sum += f[a] * g[b] * h[3 - a - b];
    sum *= area;
    for (int c = 0; c < 4; ++c) {
        for (int k = 0; k < 3; ++k) child[c][k] = mean[k];
        for (int t = 0; t < 3; ++t)
            child[c][0] += SIGNS[t][c] * f[t], child[c][1] += SIGNS[t][c] * g[t], child[c][2] += SIGNS[t][c] * h[t];
        sum += below(s, start + size, 4 * size, 4 * i + c, child[c], area / 4);
    }
    return sum;
}

constexpr int64_t BLOCK = 64;  // points of a thread's turn, which share its scratch

extern "C" int32_t ptt_adaptive(const Adaptive *g) {
    const Sparse functions[3] = {{g->indices_f, g->values_f, g->count_f},
                                 {g->indices_g, g->values_g, g->count_g},
                                 {g->indices_h, g->values_h, g->count_h}};
    in_parallel((g->points + BLOCK - 1) / BLOCK, g->threads, [&](int64_t b) {
        Scratch s(g->n);
        for (int64_t p = BLOCK * b; p < std::min(g->points, BLOCK * (b + 1)); ++p) {
            for (int f = 0; f < 3; ++f) s.put(functions[f], p, f);
            float sum = 0;
            for (int32_t r = 0; r < ROOTS; ++r) {
                const float *mean = s.value.data() + 3 * r;
                sum += mean[0] * mean[1] * mean[2] + below(s, 0, ROOTS, r, mean, 1.0f);
            }
            g->out[p] = sum;
            s.clear(functions, p);
        }
    });
    return DONE;
}
