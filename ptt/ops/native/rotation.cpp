// Local light by the three operators of ptt/ops/rotation.py, and what slices of a BRDF reflect of it (ptt/ops/slices.py).
//
// Light has four channels, colours and a zero: a value is one vector of 16 bytes. Local maps are computed and transformed
// while they are in the cache.

#include "lanes.h"

#include <vector>

static inline Four four(const float *p) {
    Four x;
    std::memcpy(&x, p, sizeof x);
    return x;
}

// ptt.ops.haar.analyse of m * m Fours; `map` is overwritten
static inline void analyse(Four *map, Four *out, int64_t m) {
    for (int64_t size = m; size > 1; size /= 2) {
        const int64_t h = size / 2;
        for (int64_t i = 0; i < h; ++i) {
            const Four *top = map + 2 * i * size, *bottom = top + size;
            Four *mean = map + i * h, *right = out + i * m + h, *low = out + (h + i) * m;
            for (int64_t j = 0; j < h; ++j) {
                const Four a = top[2 * j], b = top[2 * j + 1], c = bottom[2 * j], d = bottom[2 * j + 1];
                right[j] = (a - b + c - d) * 0.5f;
                low[j] = (a + b - c - d) * 0.5f, low[h + j] = (a - b - c + d) * 0.5f;
                mean[j] = (a + b + c + d) * 0.5f;  // what it overwrites has been read
            }
        }
    }
    out[0] = map[0];
}

// run(frame, map) fills a local map of m * m cells; its coefficients are in out (frames, m, m)
template <class Run>
static inline void local_maps(float *out, int64_t frames, int64_t m, int threads, Run run) {
    in_parallel(frames, threads, [&](int64_t f) {
        static thread_local std::vector<float> scratch;
        scratch.resize(m * m * 4 + 16);
        Four *map = (Four *)(((uintptr_t)scratch.data() + 63) & ~uintptr_t(63));
        run(f, map);
        analyse(map, (Four *)out + f * m * m, m);
    });
}

// The sum of what a cell of S reads of a source of Fours, from k on, which moves to the next cell's.
static inline Four read(const float *source, const int32_t *reads, int64_t &k, int64_t end) {
    Four sum = {};
    for (; k < end; ++k) sum += (float)(reads[k] & 255) * four(source + (reads[k] >> 8) * CHANNELS);
    return sum;
}

extern "C" int32_t ptt_local_light(const LocalLight *g) {
    const int64_t cells = g->m * g->m;
    local_maps(g->out, g->frames, g->m, g->threads, [=](int64_t f, Four *map) {
        const int64_t *start = g->starts + f * cells;
        int64_t k = start[0];
        for (int64_t cell = 0; cell < cells; ++cell) map[cell] = read(g->source, g->reads, k, start[cell + 1]) * g->unit;
    });
    return DONE;
}

static inline void keep(float *out, float x) { *out = x; }
static inline void keep(uint8_t *out, float x) { *out = (uint8_t)(x + 0.5f); }
static inline void keep(Half *out, float x) {
    const _Float16 half = (_Float16)x;
    std::memcpy(out, &half, sizeof half);
}

// `count` numbers as the table keeps them: over a scale that makes the largest `largest`, or as they are where that is 0
template <class T>
static inline void stored(const float *x, int64_t count, float largest, T *out, float *scale) {
    float most = TINY;
    for (int64_t i = 0; i < count; ++i) most = std::max(most, std::fabs(x[i]));
    *scale = largest > 0 ? most / largest : 1.0f;
    const float by = largest > 0 ? largest / most : 1.0f;
    for (int64_t i = 0; i < count; ++i) keep(out + i, x[i] * by);
}

template <class T>
static Status resampled(const ResampledValues &g) {
    in_parallel(g.frames, g.threads, [&](int64_t f) {
        static thread_local std::vector<float> rows;
        const int64_t count = 3 * g.cells;
        rows.resize(count);
        const int64_t *start = g.starts + f * g.cells;
        int64_t k = start[0];
        for (int64_t cell = 0; cell < g.cells; ++cell) {
            const Four sum = read(g.source, g.reads, k, start[cell + 1]);
            for (int c = 0; c < 3; ++c) rows[c * g.cells + cell] = sum[c] * g.unit;
        }
        stored(rows.data(), count, g.largest, (T *)g.values + f * count, g.scale + f);
    });
    return DONE;
}

// S applied without a transform.
extern "C" int32_t ptt_resampled_values(const ResampledValues *g) {
    switch (g->type) {
        case FLOAT32: return resampled<float>(*g);
        case FLOAT16: return resampled<Half>(*g);
        case UINT8: return resampled<uint8_t>(*g);
        default: return UNKNOWN;
    }
}

extern "C" int32_t ptt_resampled_light(const ResampledLight *g) {
    const int64_t m = g->m, each = g->each, padded = g->padded, n = g->n;
    local_maps(g->out, g->count, m, g->threads, [=](int64_t f, Four *map) {
        static thread_local std::vector<int32_t> at;
        at.resize(padded);
        const float half = 0.5f * n, *turn = g->frames + 9 * f, *directions = g->directions;
        for (int64_t i = 0; i < padded; i += LANES) {
            const Lanes local[3] = {load(directions + i), load(directions + padded + i), load(directions + 2 * padded + i)};
            Lanes d[3], a, b;
            turned(local, turn, d);
            octahedral(d, a, b);
            const Ints column = clamp(whole((a + 1.0f) * half), n - 1), row = clamp(whole((b + 1.0f) * half), n - 1);
            const Ints cell = row * (int32_t)n + column;
            std::memcpy(at.data() + i, &cell, sizeof cell);
        }
        const int32_t *k = at.data();
        for (int64_t cell = 0; cell < m * m; ++cell, k += each) {
            Four sum = {};
            for (int64_t i = 0; i < each; ++i) sum += four(g->source + k[i] * CHANNELS);
            map[cell] = sum * (1.0f / each);
        }
    });
    return DONE;
}

// Rows of R in whole units: once to count those that are kept, once to write them.
extern "C" int32_t ptt_quantised_rows(const QuantisedRows *g) {
    const int64_t rows = g->m * g->m;
    in_parallel(g->frames, g->threads, [=](int64_t f) {
        static thread_local std::vector<double> sum;
        static thread_local std::vector<int32_t> touched;
        sum.assign(g->cells, 0.0);
        for (int64_t row = 0; row < rows; ++row) {
            touched.clear();
            for (int64_t p = g->begins[row]; p < g->begins[row + 1]; ++p) {
                const int64_t *start = g->starts + f * rows + g->parts[p];
                for (int64_t k = start[0]; k < start[1]; ++k) {
                    const double share = g->shares[p] * (g->reads[k] & 255);
                    const int64_t first = (g->reads[k] >> 8) * g->terms;
                    for (int64_t t = first; t < first + g->terms; ++t) {
                        double &x = sum[g->at[t]];
                        if (x == 0) touched.push_back(g->at[t]);
                        x += share * g->worth[t];
                    }
                }
            }
            if (g->numbers) std::sort(touched.begin(), touched.end());
            int64_t to = g->numbers ? g->begin[f * rows + row] : 0;
            for (const int32_t column : touched) {
                const long number = std::lrint(sum[column] * g->scale);
                sum[column] = 0;  // one that was touched twice is 0 by then, and not kept
                if (std::labs(number) < g->threshold) continue;
                if (g->numbers) {
                    g->numbers[to] = number;
                    if (g->wide) ((int32_t *)g->columns)[to] = column;
                    else ((int16_t *)g->columns)[to] = column;
                }
                ++to;
            }
            if (!g->numbers) g->counts[f * rows + row] = to;
        }
    });
    return DONE;
}

// R in 16 bits
template <class Column>
static Status rotated(const RotatedLight &g) {
    constexpr int64_t BLOCK = 256;  // rows of a thread's turn
    const Column *columns = (const Column *)g.columns;
    in_parallel((g.rows + BLOCK - 1) / BLOCK, g.threads, [&](int64_t block) {
        for (int64_t row = block * BLOCK; row < std::min((block + 1) * BLOCK, g.rows); ++row) {
            Four sum[4] = {};
            int64_t k = g.starts[row];
            const int64_t end = g.starts[row + 1];
            for (; k + 4 <= end; k += 4)
                for (int j = 0; j < 4; ++j)
                    sum[j] += (float)g.numbers[k + j] * four(g.source + CHANNELS * columns[k + j]);
            for (; k < end; ++k) sum[0] += (float)g.numbers[k] * four(g.source + CHANNELS * columns[k]);
            const Four all = ((sum[0] + sum[1]) + (sum[2] + sum[3])) * g.unit;
            std::memcpy(g.out + CHANNELS * row, &all, sizeof all);
        }
    });
    return DONE;
}

extern "C" int32_t ptt_rotated_light(const RotatedLight *g) {
    return g->wide ? rotated<int32_t>(*g) : rotated<int16_t>(*g);
}

extern "C" int32_t ptt_reflected(const Reflected *g) {
    const int64_t v = g->points;
    in_parallel(v / LANES, g->threads, [=](int64_t block) {
        const int64_t at = block * LANES;
        Lanes mirrored[3], length = {}, up = {};
        for (int c = 0; c < 3; ++c) {
            mirrored[c] = g->distant ? load(g->eye + c * v + at) : g->eye[c] - load(g->position + c * v + at);
            length += mirrored[c] * mirrored[c];
            up += mirrored[c] * load(g->normal + c * v + at);
        }
        const Lanes scale = 1.0f / root(most(length, all(TINY)));
        const Ints seen = faces_eye(*g, at, up * scale);
        if (!any(seen)) {
            std::memset(g->out + at * 4, 0, LANES * 4 * sizeof(float));
            return;
        }
        up = 2.0f * most(up, Lanes{});
        for (int c = 0; c < 3; ++c) mirrored[c] = (up * load(g->normal + c * v + at) - mirrored[c]) * scale;
        const float half = 0.5f * g->views;
        int32_t slice[CORNERS][LANES];
        for (int k = 0; k < CORNERS; ++k) {
            Ints near, first;
            std::memcpy(&near, g->near + k * v + at, sizeof near);
            std::memcpy(&first, g->first + k * v + at, sizeof first);
            Lanes d[3] = {};
            for (int a = 0; a < 3; ++a)
                for (int c = 0; c < 3; ++c) d[a] += mirrored[c] * gather(g->frames + 3 * a + c, near * 9);
            const Lanes to_face = 1.0f / most(size(d[0]) + size(d[1]) + size(d[2]), all(TINY));
            const Ints column = clamp(whole((1.0f - (d[0] + d[1]) * to_face) * half), g->views - 1);
            const Ints row = clamp(whole((1.0f - (d[0] - d[1]) * to_face) * half), g->views - 1);
            const Ints cell = first + row * g->views + column;
            std::memcpy(slice[k], &cell, sizeof cell);
        }
        for (int64_t l = 0; l < LANES; ++l) {
            Four total = {};
            for (int k = 0; k < CORNERS && seen[l]; ++k) {
                const int64_t corner = k * v + at + l, s = slice[k][l] * g->kept;
                const float *light = g->light + g->near[corner] * g->width * 4;
                Four sum[4] = {};
                for (int64_t t = 0; t < g->kept; t += LANES) {
                    float value[LANES];
                    store(value, load(g->values + s + t));
                    for (int i = 0; i < LANES; ++i) sum[i & 3] += value[i] * four(light + 4 * g->terms[s + t + i]);
                }
                total += g->weights[corner] * ((sum[0] + sum[1]) + (sum[2] + sum[3]));
            }
            std::memcpy(g->out + (at + l) * 4, &total, sizeof total);
        }
    });
    return DONE;
}
