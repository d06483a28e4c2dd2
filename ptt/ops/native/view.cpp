// The view step of ptt/ops/view.py in one pass over the points (float32, isotropic lobes, three channels):
//
//     B[v, c] = sum over o of  V[o, wo] Q[c, o, v]
//             + specular[c] sum over k of  rho_k(wo) (E_k[c, a_k] cut_k[v, a_k] + sum over s of  z_k[s] Y_s(a) I[c, s, v])
//
// Q and I are in 16 bits, by a unit for each row of a group. Points go LANES at a time, one in each lane of a vector;
// the light of lobes, which each point reads in places of its own, is summed point by point. `look` finds where a group
// looks and fetches its words of the cuts ahead of time; `shade` sums, AHEAD groups later. Indices are clamped, so that
// no input reads, and no point writes, out of bounds.

#include "lanes.h"

constexpr int AHEAD = 1;  // groups, whose cuts are fetched: in a trial on the engine 2 and 4 were no faster

// use(i, weighted sum of column i) of each of the columns of a table, in turn
template <int J, class Use>
static inline __attribute__((always_inline)) void mix(const float *table, int columns, const Ints (&at)[J],
                                                      const Lanes (&weight)[J], Use use) {
    int i = 0;
    if (columns >= 4)
        while (i < columns) {
            const int first = std::min(i, columns - 4);  // overlaps the four before at the end
            Lanes sum[4] = {}, x[4];
            for (int j = 0; j < J; ++j) {
                gather_four(table + first, at[j], x);
                for (int m = 0; m < 4; ++m) sum[m] += weight[j] * x[m];
            }
            for (; i < first + 4; ++i) use(i, sum[i - first]);
        }
    for (; i < columns; ++i) {
        Lanes sum = {};
        for (int j = 0; j < J; ++j) sum += weight[j] * gather(table + i, at[j]);
        use(i, sum);
    }
}

// ptt.ops.harmonics.evaluate, of order 4
static inline void harmonics(Lanes x, Lanes y, Lanes z, Lanes *out) {
    Lanes zz = z * z, two = x * y, cos2 = x * x - y * y, five = 5.0f * zz - 1.0f;
    out[0] = all(0.28209479177387814f);
    out[1] = 0.4886025119029199f * y;
    out[2] = 0.4886025119029199f * z;
    out[3] = 0.4886025119029199f * x;
    out[4] = 1.0925484305920792f * two;
    out[5] = 1.0925484305920792f * y * z;
    out[6] = 0.31539156525252005f * (3.0f * zz - 1.0f);
    out[7] = 1.0925484305920792f * x * z;
    out[8] = 0.5462742152960396f * cos2;
    out[9] = 0.5900435899266435f * y * (3.0f * x * x - y * y);
    out[10] = 2.890611442640554f * two * z;
    out[11] = 0.4570457994644658f * y * five;
    out[12] = 0.3731763325901154f * z * (5.0f * zz - 3.0f);
    out[13] = 0.4570457994644658f * x * five;
    out[14] = 1.445305721320277f * cos2 * z;
    out[15] = 0.5900435899266435f * x * (x * x - 3.0f * y * y);
}

// Of a group of points: which show highlights, and whether any does; the direction to the eye, local; the axes of lobes,
// local (-along x, -along y, up), and what they are made of in the world: along times flat and up times normal.
template <int K>
struct Look {
    Ints seen;
    bool some;
    Lanes wo[3], flat[3], normal[3], rho[K + !K], along[K + !K], up[K + !K];
    Place cut[K + !K];
    Ints first[K + !K];  // word of the cuts
    bool lit[K + !K];     // whether any point has the lobe, and direct light
};

template <int K>
static inline void look(const View &g, int64_t v, Look<K> &at) {
    const int64_t n = g.blocks * g.width;
    Lanes toward[3], length = all(0);
    for (int c = 0; c < 3; ++c) {
        toward[c] = g.distant ? load(g.eye + c * n + v) : g.eye[c] - load(g.position + c * n + v);
        length += toward[c] * toward[c];
    }
    const Lanes scale = 1.0f / root(most(length, all(TINY)));
    if (!g.distant)
        for (auto &t : toward) t *= scale;
    for (int r = 0; r < 3; ++r) {
        at.wo[r] = all(0);
        for (int c = 0; c < 3; ++c) at.wo[r] += (at.normal[c] = load(g.frame + (3 * r + c) * n + v)) * toward[c];
    }
    at.seen = faces_eye(g, v, at.wo[2]), at.some = any(at.seen);
    if (!at.some) return;
    if constexpr (K > 0) {
        for (int c = 0; c < 3; ++c) at.flat[c] = at.wo[2] * at.normal[c] - toward[c];
        const Lanes x = -at.wo[0], y = -at.wo[1];
        Lanes tilt = angle(root(x * x + y * y), size(at.wo[2])) * (g.tilts * 0.63661977f) - 0.5f;
        tilt = least(most(tilt, all(0)), all(g.tilts - 1));
        const Ints below = clamp(whole(tilt), std::max(g.tilts - 2, 0)), above = clamp(below + 1, g.tilts - 1);
        tilt -= real(below);
        const Ints rows[2] = {below * K, above * K}, pairs[2] = {2 * rows[0], 2 * rows[1]};
        const Lanes shares[2] = {1.0f - tilt, tilt};
        mix(g.rho, K, rows, shares, [&](int k, Lanes r) { at.rho[k] = r; });
        mix(g.axes, 2 * K, pairs, shares, [&](int k, Lanes r) { (k < K ? at.along[k] : at.up[k - K]) = r; });
        const Lanes flat = size(x) + size(y), a = x + y, b = x - y;
        for (int k = 0; k < K; ++k) {
            if (!(at.lit[k] = g.maps && any(at.rho[k] != 0))) continue;
            const Lanes scaled = at.along[k] / most(size(at.along[k]) * flat + size(at.up[k]), all(TINY));
            at.cut[k] = place(a * scaled, b * scaled, g.cells);
            at.first[k] = in_row(at.cut[k].row, g.cells) + in_column(at.cut[k].column);
        }
    }
}

// Asks for the words of the cuts of lane l: the first corner of each lobe, with which the others often share a tile.
template <int K>
static inline void fetch(const View &g, int64_t v, const Look<K> &at, int l) {
    if (!at.some) return;
    const int32_t *cuts = g.cuts + (v + l) * g.cells * g.cells;
    for (int k = 0; k < K; ++k)
        if (at.lit[k]) __builtin_prefetch(cuts + at.first[k][l]);
}

// The light about the axes: sum over k of rho_k cut_k E_k, channel by channel.
template <int K>
static inline void reflect(const View &g, int64_t v, const Look<K> &at, Lanes *lit) {
    const int stride = g.cells * g.cells;
    const Ints point = lane() * stride;
    Lanes flat[3], normal[3];  // turned with the light
    turned(at.flat, g.turn, flat), turned(at.normal, g.turn, normal);
    alignas(64) int32_t first[K][LANES];
    alignas(64) float share[K][3][LANES];
    int count = 0;
    for (int k = 0; k < K; ++k) {
        if (!at.lit[k]) continue;
        const Place &p = at.cut[k];
        const Ints rows[2] = {in_row(p.row, g.cells), in_row(p.row + 1, g.cells)};
        const Ints columns[2] = {in_column(p.column), in_column(p.column + 1)};
        Lanes cut[4], d[3];
        for (int j = 0; j < 4; ++j) {
            const Ints word = (Ints)gather((const float *)g.cuts + v * stride, rows[j >> 1] + columns[j & 1] + point);
            cut[j] = real((word >> (8 * (int)g.which[k])) & 255);
        }
        for (int c = 0; c < 3; ++c) d[c] = at.along[k] * flat[c] + at.up[k] * normal[c];
        const Place on = place_on_sphere(d, g.map);
        const Ints from = ((k * g.map + on.row) * g.map + on.column) * 4;
        const Lanes part = blend(cut, p.x, p.y) * at.rho[k] * (1.0f / 255), right = part * on.x;
        const Lanes shares[3] = {part - right, right, on.y};
        std::memcpy(first[count], &from, sizeof from), std::memcpy(share[count++], shares, sizeof shares);
    }
    alignas(64) float sums[LANES][4];
    for (int l = 0; l < LANES; ++l) {
        Eight sum = {};  // of left corners, then of right ones
        for (int k = 0; k < count; ++k) {
            const float *p = g.maps + first[k][l], left = share[k][0][l], right = share[k][1][l];
            Eight above, below;
            std::memcpy(&above, p, sizeof above), std::memcpy(&below, p + 4 * g.map, sizeof below);
            const Eight shares = {left, left, left, left, right, right, right, right};
            sum += shares * (above + share[k][2][l] * (below - above));
        }
        Four halves[2];
        std::memcpy(halves, &sum, sizeof sum);
        halves[0] += halves[1];
        std::memcpy(sums[l], halves, sizeof *halves);
    }
    Lanes out[4];
    gather_four(sums[0], 4 * lane(), out);
    for (int c = 0; c < 3; ++c) lit[c] = out[c];
}

// What a group sends out; of a group without highlights what is diffuse.
template <int K>
static inline void shade(const View &g, int64_t v, const Look<K> &at, int64_t later, const Look<K> &next) {
    const int w = g.width, o = g.factors;
    const int16_t *sent = g.values + (v / w * 3 * g.rows) * w + v % w;
    const int16_t *q[3] = {sent, sent + g.rows * w, sent + 2 * g.rows * w};
    const float *own = g.unit + v / w * 3 * g.rows, *unit[3] = {own, own + g.rows, own + 2 * g.rows};
    const auto row = [=](int c, int x) { return unit[c][x] * load(q[c] + x * w); };
    Lanes out[3], glossy[3] = {};
    for (int c = 0; c < 3; ++c) out[c] = row(c, 0) + row(c, g.rows - 1);
    if (g.colour)
        for (int c = 0; c < 3; ++c) out[c] *= load(g.colour + c * g.blocks * w + v);
    if (o > 1 && at.some) {
        Corners on = corners(at.wo[0], at.wo[1], g.disk, false);
        for (auto &cell : on.cell) cell *= o - 1;
        mix(g.outgoing, o - 1, on.cell, on.weight, [&](int f, Lanes factor) {
            for (int c = 0; c < 3; ++c) glossy[c] += factor * row(c, 1 + f);
        });
    }
    if constexpr (K > 0) {
        Lanes lit[3] = {};
        if (g.maps && at.some) reflect(g, v, at, lit);
        if (!g.harmonics || !at.some)
            for (int l = 0; l < LANES; ++l) fetch(g, later, next, l);
        else {
            Lanes basis[HARMONICS], along = all(0), up = all(0);
            for (int k = 0; k < K; ++k) along += at.rho[k] * at.along[k], up += at.rho[k] * at.up[k];
            const Lanes x = -along * at.wo[0], y = -along * at.wo[1];
            const Lanes scale = 1.0f / most(root(x * x + y * y + up * up), all(TINY));
            harmonics(x * scale, y * scale, up * scale, basis);
            for (int s = 0; s < HARMONICS; ++s) {
                Lanes blur = at.rho[0] * g.blurs[s];
                for (int k = 1; k < K; ++k) blur += at.rho[k] * g.blurs[k * HARMONICS + s];
                blur *= basis[s];
                if (s < LANES) fetch(g, later, next, s);
                for (int c = 0; c < 3; ++c) lit[c] += blur * row(c, o + s);
            }
        }
        for (int c = 0; c < 3; ++c) glossy[c] += lit[c] * g.specular[c];
    }
    for (int c = 0; c < 3; ++c) out[c] += at.seen ? glossy[c] : all(0);
    for (int l = 0; l < LANES; ++l) put_at(g, v + l, Four{out[0][l], out[1][l], out[2][l]});
}

template <int K>
static void run(const View &g) {
#pragma omp parallel num_threads(g.threads)
    by_parts(g.blocks * g.width / LANES, [&](int64_t first, int64_t end) {
        Look<K> at[1 + AHEAD];
        for (int64_t i = first - AHEAD; i < end; ++i) {
            const int64_t later = std::min(i + AHEAD, end - 1);
            Look<K> &next = at[(i + AHEAD) % (1 + AHEAD)];
            look(g, later * LANES, next);
            if (i >= first) shade(g, i * LANES, at[i % (1 + AHEAD)], later * LANES, next);
        }
    });
}

extern "C" int32_t ptt_view(const View *g) {
    switch (g->lobes) {
        case 0: run<0>(*g); return DONE;
        case 1: run<1>(*g); return DONE;
        case 2: run<2>(*g); return DONE;
        case 3: run<3>(*g); return DONE;
        case 4: run<4>(*g); return DONE;
        default: return UNKNOWN;
    }
    static_assert(MOST_LOBES == 4, "a case for each number of lobes");
}
