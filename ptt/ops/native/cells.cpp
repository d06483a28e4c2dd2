// Cells of f cos of ptt/ops/cells.py, by the algorithm of Lloyd, and what each of them reflects.
//
// Directions, masses and centres are whole numbers, so small that their products and sums are exact in any order.

#include "lanes.h"

#include <numeric>
#include <vector>

typedef double FourDoubles __attribute__((vector_size(32)));

constexpr int SETS = 8;  // of sums, taken in turn: neighbours are mostly of one cell, and would wait for each other

// The nodes of a row that reflect: their directions, whole; directions times masses; what they add to their cells.
struct Nodes {
    std::vector<float> x, y, z;
    std::vector<FourDoubles> moment;
    std::vector<Eight> share;
    std::vector<int32_t> cell;
    int64_t count, padded;  // to whole vectors

    explicit Nodes(int64_t n) : x(n + LANES), y(n + LANES), z(n + LANES), moment(n), share(n), cell(n + LANES) {}
};

static void take(const CellSums &g, int64_t tilt, int64_t row, Nodes &nodes) {
    const int64_t n = g.nodes;
    const float *d = g.whole + tilt * 3 * n, *to = g.mirrored + tilt * 3 * n;
    const float *mass = g.mass + row * n, *c = g.reflected + row * 3 * n;
    int64_t count = 0;
    for (int64_t i = 0; i < n; ++i, c += 3) {
        if (c[0] == 0 && c[1] == 0 && c[2] == 0) continue;
        const double m = mass[i];
        const float all = c[0] + c[1] + c[2];
        nodes.x[count] = d[i], nodes.y[count] = d[n + i], nodes.z[count] = d[2 * n + i];
        nodes.moment[count] = FourDoubles{m * d[i], m * d[n + i], m * d[2 * n + i]};
        nodes.share[count++] = Eight{all * to[i], all * to[n + i], all * to[2 * n + i], c[0], c[1], c[2]};
    }
    nodes.count = count, nodes.padded = (count + LANES - 1) / LANES * LANES;
}

// The cell of each node: that of the centre that it is nearest to, the first of such.
static void assign(Nodes &nodes, const std::vector<Four> &centres) {
    for (int64_t i = 0; i < nodes.padded; i += LANES) {
        const Lanes x = load(&nodes.x[i]), y = load(&nodes.y[i]), z = load(&nodes.z[i]);
        Lanes nearest = all(-HUGE_VALF);
        Ints cell = {};
        for (int k = 0; k < (int)centres.size(); ++k) {
            const Lanes near = x * centres[k][0] + y * centres[k][1] + z * centres[k][2];
            const Ints nearer = near > nearest;
            nearest = nearer ? near : nearest, cell = nearer ? k - Ints{} : cell;
        }
        std::memcpy(&nodes.cell[i], &cell, sizeof cell);
    }
}

// Moves the centres to the means of their cells; false where all of them stay.
static bool improve(Nodes &nodes, float steps, std::vector<Four> &centres, std::vector<FourDoubles> &sums) {
    assign(nodes, centres);
    std::fill(sums.begin(), sums.end(), FourDoubles{});
    for (int64_t i = 0; i < nodes.count; ++i) sums[nodes.cell[i] * SETS + i % SETS] += nodes.moment[i];
    bool moved = false;
    for (size_t k = 0; k < centres.size(); ++k) {
        FourDoubles s = {};
        for (int set = 0; set < SETS; ++set) s += sums[k * SETS + set];
        const double length = std::sqrt(s[0] * s[0] + s[1] * s[1] + s[2] * s[2]);
        if (!(length > 0)) continue;
        for (int c = 0; c < 3; ++c) {
            const float at = std::nearbyint(s[c] * (steps / length));
            moved |= at != centres[k][c], centres[k][c] = at;
        }
    }
    return moved;
}

// What each of `count` cells reflects: first moments, and sums, to out (count, 6).
static void add(const Nodes &nodes, int64_t count, float *out) {
    std::vector<Eight> sums(count * SETS);
    for (int64_t i = 0; i < nodes.count; ++i) sums[nodes.cell[i] * SETS + i % SETS] += nodes.share[i];
    for (int64_t k = 0; k < count; ++k) {
        Eight sum = {};
        for (int set = 0; set < SETS; ++set) sum += sums[k * SETS + set];
        std::memcpy(out + 6 * k, &sum, 6 * sizeof(float));
    }
}

// Of a turn, `count` cells from the cell `from` of each row on.
static void divide(const CellSums &g, int64_t turn, int64_t from, int64_t count) {
    Nodes nodes(g.nodes);
    std::vector<Four> centres(count);
    std::vector<FourDoubles> sums(count * SETS);
    for (int64_t k = 0; k < count; ++k) {
        const float *p = g.centres + 3 * (turn * g.cells + from + k);
        centres[k] = Four{p[0], p[1], p[2]};
    }
    for (int64_t tilt = g.tilts - 1; tilt >= 0; --tilt) {
        const int64_t row = turn * g.tilts + tilt;
        take(g, tilt, row, nodes);
        for (int i = tilt == g.tilts - 1 ? g.first : g.rounds; i > 0 && improve(nodes, g.steps, centres, sums); --i) {}
        assign(nodes, centres);
        add(nodes, count, g.out + (row * g.cells + from) * 6);
    }
}

extern "C" int32_t ptt_cell_sums(const CellSums *g) {
    in_parallel(g->turns * g->sets, g->threads, [=](int64_t i) {
        const int64_t set = i % g->sets, from = std::accumulate(g->counts, g->counts + set, (int64_t)0);
        divide(*g, i / g->sets, from, g->counts[set]);
    });
    return DONE;
}
