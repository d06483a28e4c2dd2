// Maps made ready, of ptt/ops/latlong.py: `even_rows`, then means over the cells of an octahedral map by the midpoint
// rule, each sample weighted by what the octahedron's faces are to the sphere there, |p|^-3 of a point p of a face.

#include "lanes.h"

#include <vector>

typedef double Sums __attribute__((vector_size(32)));  // of the four channels

// Means of texels over `width` of them along a periodic row of n, into out; sums: scratch (n + 1)
static inline void box(const Four *texels, Four *out, Sums *sums, int64_t n, double width) {
    if (width <= 1) {
        if (out != texels) std::memcpy(out, texels, n * sizeof *out);
        return;
    }
    const double reach = std::min(width, (double)n) / 2;
    sums[0] = Sums{};
    for (int64_t x = 0; x < n; ++x) sums[x + 1] = sums[x] + __builtin_convertvector(texels[x], Sums);
    for (int64_t x = 0; x < n; ++x) {
        Sums total = {};
        for (int side : {-1, 1}) {  // the sum from 0 to the end of the reach, linear within texels
            const double end = x + 0.5 + side * reach, turns = std::floor(end / n), rest = end - turns * n;
            const int64_t column = std::min<int64_t>((int64_t)rest, n - 1);
            const Sums sum = sums[column] + (sums[column + 1] - sums[column]) * (rest - column) + turns * sums[n];
            total += side * sum;
        }
        out[x] = __builtin_convertvector(total / (2 * reach), Four);
    }
}

// A row of texels (n, 3), evened, in the middle of out (n + 2)
static inline void even_row(const float *row, Four *out, Sums *sums, int64_t n, double width) {
    for (int64_t x = 0; x < n; ++x) out[1 + x] = Four{row[3 * x], row[3 * x + 1], row[3 * x + 2], 0};
    std::vector<Four> once(n);
    box(out + 1, once.data(), sums, n, width);
    box(once.data(), out + 1, sums, n, width - 1);
    out[0] = out[n], out[n + 1] = out[1];
}

// atan2(s, z) of s >= 0 and any z, 0 .. pi
static inline Lanes polar(Lanes s, Lanes z) {
    const Lanes half = angle(s, size(z));
    return z < 0 ? 3.14159265f - half : half;
}

// Samples of a row at height b of the square, `count` a cell: their weighted sums and weights are added to cells (n)
static inline void sample_row(const OctahedralMeans &g, const Four *even, float b, Four *cells, float *weights) {
    const int64_t across = g.n * g.samples, stride = g.width + 2;
    const float step = 2.0f / across, to_rows = g.height * 0.318309886f, to_columns = g.width * 0.159154943f;
    for (int64_t first = 0; first < across; first += LANES) {
        const Lanes a = (real(lane() + (int)first) + 0.5f) * step - 1.0f;
        const Lanes y0 = all(b), z = 1.0f - size(a) - size(y0);
        const Lanes x = z < 0 ? signed_as(1.0f - size(y0), a) : a, y = z < 0 ? signed_as(1.0f - size(a), y0) : y0;
        const Lanes flat = x * x + z * z, scale = 1.0f / root(flat + y * y), weight = scale * scale * scale;
        Lanes u = polar(size(x), -z) * to_columns, v = polar(root(flat), y) * to_rows + 0.5f;
        u = (x < 0 ? (float)g.width - u : u) + 0.5f;
        const Ints column = clamp(whole(u), g.width), row = clamp(whole(v), g.height);
        const Lanes right = u - real(column), below = v - real(row);
        const Ints at = row * (int)stride + column;
        for (int l = 0; l < LANES && first + l < across; ++l) {
            const Four *t = even + at[l];
            const Four top = t[0] + right[l] * (t[1] - t[0]);
            const Four bottom = t[stride] + right[l] * (t[stride + 1] - t[stride]);
            const int64_t cell = (first + l) / g.samples;
            cells[cell] += weight[l] * (top + below[l] * (bottom - top));
            weights[cell] += weight[l];
        }
    }
}

extern "C" int32_t ptt_octahedral_means(const OctahedralMeans *g) {
    const int64_t h = g->height, w = g->width, stride = w + 2, n = g->n;
    Four *even = (Four *)g->even;
    in_parallel(h, g->threads, [=](int64_t row) {
        std::vector<Sums> sums(w + 1);
        const double sine = std::sin((row + 0.5) * 3.14159265358979 / h);
        even_row(g->texels + 3 * w * row, even + stride * (1 + row), sums.data(), w,
                 g->arc / (sine * 6.28318530717959 / w));
    });
    for (int64_t pole : {0, 1}) {  // beyond it lies its own row, half a turn on
        const Four *own = even + stride * (pole ? h : 1) + 1;
        Four *beyond = even + stride * (pole ? h + 1 : 0);
        for (int64_t x = 0; x < stride; ++x) beyond[x] = own[(x - 1 + w + w / 2) % w];
    }
    in_parallel(n, g->threads, [=](int64_t row) {
        std::vector<Four> cells(n);
        std::vector<float> weights(n);
        for (int64_t k = 0; k < g->samples; ++k)
            sample_row(*g, even, (row * g->samples + k + 0.5f) * 2 / (n * g->samples) - 1, cells.data(),
                       weights.data());
        for (int64_t cell = 0; cell < n; ++cell)
            for (int c = 0; c < 3; ++c) g->out[3 * (row * n + cell) + c] = cells[cell][c] / weights[cell];
    });
    return DONE;
}
