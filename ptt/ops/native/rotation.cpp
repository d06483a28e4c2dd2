// Local light by the three operators of ptt/ops/rotation.py, and what slices of a BRDF reflect of it (ptt/ops/slices.py).
//
// Light has four channels, colours and a zero: a value is one vector of 16 bytes. Local maps are computed and transformed
// while they are in the cache.

#include "lanes.h"

#include <vector>

typedef float Four __attribute__((vector_size(16)));

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

// source (N) Fours; starts (frames * m * m + 1); reads: cell * 256 + count, the counts of a cell sum to 1 / unit
extern "C" void ptt_local_light(const float *source, const int64_t *starts, const int32_t *reads, float *out,
                                int64_t frames, int64_t m, float unit, int threads) {
    local_maps(out, frames, m, threads, [=](int64_t f, Four *map) {
        const int64_t *start = starts + f * m * m;
        int64_t k = start[0];
        for (int64_t cell = 0; cell < m * m; ++cell) {
            Four sum = {};
            for (; k < start[cell + 1]; ++k) sum += (float)(reads[k] & 255) * four(source + (reads[k] >> 8) * 4);
            map[cell] = sum * unit;
        }
    });
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

// S applied without a transform: out (frames, 3, cells) of a type, 0 for float32, 1 for 16 bits, 2 for 8; scale (frames)
extern "C" void ptt_resampled_values(const float *source, const int64_t *starts, const int32_t *reads, void *out,
                                     float *scale, int64_t frames, int64_t cells, float unit, float largest, int type,
                                     int threads) {
    in_parallel(frames, threads, [=](int64_t f) {
        static thread_local std::vector<float> rows;
        const int64_t count = 3 * cells;
        rows.resize(count);
        const int64_t *start = starts + f * cells;
        int64_t k = start[0];
        for (int64_t cell = 0; cell < cells; ++cell) {
            Four sum = {};
            for (; k < start[cell + 1]; ++k) sum += (float)(reads[k] & 255) * four(source + (reads[k] >> 8) * 4);
            for (int c = 0; c < 3; ++c) rows[c * cells + cell] = sum[c] * unit;
        }
        switch (type) {
            case 0: return stored(rows.data(), count, largest, (float *)out + f * count, scale + f);
            case 1: return stored(rows.data(), count, largest, (Half *)out + f * count, scale + f);
            case 2: return stored(rows.data(), count, largest, (uint8_t *)out + f * count, scale + f);
        }
    });
}

// frames (f, 3, 3); directions (3, m * m * each), of the samples of each cell, padded to whole vectors
extern "C" void ptt_resampled_light(const float *source, const float *frames, const float *directions, float *out,
                                    int64_t count, int64_t m, int64_t each, int64_t padded, int64_t n, int threads) {
    local_maps(out, count, m, threads, [=](int64_t f, Four *map) {
        static thread_local std::vector<int32_t> at;
        at.resize(padded);
        const float half = 0.5f * n, *turn = frames + 9 * f;
        for (int64_t i = 0; i < padded; i += LANES) {
            const Lanes local[3] = {load(directions + i), load(directions + padded + i), load(directions + 2 * padded + i)};
            Lanes d[3];
            turned(local, turn, d);
            const Lanes scale = 1.0f / most(size(d[0]) + size(d[1]) + size(d[2]), all(TINY));
            const Lanes x = d[0] * scale, y = d[1] * scale;
            const Lanes a = d[2] < 0 ? signed_as(1.0f - size(y), x) : x, b = d[2] < 0 ? signed_as(1.0f - size(x), y) : y;
            const Ints column = clamp(whole((a + 1.0f) * half), n - 1), row = clamp(whole((b + 1.0f) * half), n - 1);
            const Ints cell = row * (int32_t)n + column;
            std::memcpy(at.data() + i, &cell, sizeof cell);
        }
        const int32_t *k = at.data();
        for (int64_t cell = 0; cell < m * m; ++cell, k += each) {
            Four sum = {};
            for (int64_t i = 0; i < each; ++i) sum += four(source + k[i] * 4);
            map[cell] = sum * (1.0f / each);
        }
    });
}

// As rotation.py lays it out: S by starts (rows + 1) and reads; `terms` basis functions of the source that differ from zero
// in each of its cells, at and worth (cells, terms); the local maps' analysis by begins (m * m + 1), parts and shares.
struct Form {
    const int64_t *starts, *begins;
    const int32_t *reads, *at, *parts;
    const double *worth, *shares;
    int64_t *kept;  // numbers of each row: counted where `numbers` is null, then where the row begins
    void *columns;
    int16_t *numbers;
    int64_t frames, m, cells, terms;
    double scale;  // of a count, to units
    int32_t threshold, wide, threads;
};

// Rows of R in whole units: once to count those that are kept, once to write them.
extern "C" void ptt_form(const Form *g) {
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
            int64_t to = g->numbers ? g->kept[f * rows + row] : 0;
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
            if (!g->numbers) g->kept[f * rows + row] = to;
        }
    });
}

// R in 16 bits: rows (frames * m * m), columns of `wide` or narrow type; coefficients (N) Fours
template <class Column>
static void rotated(const float *coefficients, const int64_t *starts, const Column *columns, const int16_t *numbers,
                    float *out, int64_t rows, float unit, int threads) {
    constexpr int64_t BLOCK = 256;
    in_parallel((rows + BLOCK - 1) / BLOCK, threads, [=](int64_t block) {
        for (int64_t row = block * BLOCK; row < std::min((block + 1) * BLOCK, rows); ++row) {
            Four sum[4] = {};
            int64_t k = starts[row];
            const int64_t end = starts[row + 1];
            for (; k + 4 <= end; k += 4)
                for (int j = 0; j < 4; ++j) sum[j] += (float)numbers[k + j] * four(coefficients + 4 * columns[k + j]);
            for (; k < end; ++k) sum[0] += (float)numbers[k] * four(coefficients + 4 * columns[k]);
            const Four all = ((sum[0] + sum[1]) + (sum[2] + sum[3])) * unit;
            std::memcpy(out + 4 * row, &all, sizeof all);
        }
    });
}

extern "C" void ptt_rotated_light(const float *coefficients, const int64_t *starts, const void *columns,
                                  const int16_t *numbers, float *out, int64_t rows, float unit, int wide, int threads) {
    if (wide) return rotated(coefficients, starts, (const int32_t *)columns, numbers, out, rows, unit, threads);
    rotated(coefficients, starts, (const int16_t *)columns, numbers, out, rows, unit, threads);
}

constexpr int CORNERS = 4;  // normals around a point

// As rotation.py lays it out: position, normal (3, v), frames (f, 3, 3), near, first and weights (4, v), light (f, x)
// Fours, slices (s, t), out (v) Fours.
struct Reflect {
    const float *position, *normal, *frames, *eye, *weights, *light;
    const int32_t *near, *first;
    const int16_t *terms;
    const Half *values;
    float *out;
    int64_t points, width, kept;  // width: x; kept: t; points and t are multiples of 16
    int32_t distant, views, threads;
};

extern "C" void ptt_reflected(const Reflect *g) {
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
            for (int k = 0; k < CORNERS; ++k) {
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
}
