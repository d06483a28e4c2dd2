// Cells of f cos of ptt/ops/cells.py, by the algorithm of Lloyd, and what each of them reflects.
//
// Directions, masses and centres are whole numbers, so small that their products and sums are exact in any order.

#include "lanes.h"

#include <vector>

typedef double FourDoubles __attribute__((vector_size(32)));

constexpr int SETS = 4;  // of sums, taken in turn: neighbours are mostly of one cell, and would wait for each other

// The nodes of a row: which of them reflect, and their directions, whole; directions times masses.
struct Nodes {
    std::vector<int64_t> node;
    std::vector<float> x, y, z;
    std::vector<FourDoubles> moment;
    std::vector<int32_t> cell;
    int64_t count, padded;  // to whole vectors

    explicit Nodes(int64_t n) : node(n), x(n + LANES), y(n + LANES), z(n + LANES), moment(n), cell(n + LANES) {}
};

static void take(const CellSums &g, int64_t tilt, int64_t row, Nodes &nodes) {
    const float *d = g.whole + tilt * 3 * g.nodes, *mass = g.mass + row * g.nodes, *c = g.reflected + row * 3 * g.nodes;
    int64_t count = 0;
    for (int64_t i = 0; i < g.nodes; ++i) {
        if (c[3 * i] == 0 && c[3 * i + 1] == 0 && c[3 * i + 2] == 0) continue;
        const double m = mass[i];
        nodes.x[count] = d[i], nodes.y[count] = d[g.nodes + i], nodes.z[count] = d[2 * g.nodes + i];
        nodes.moment[count] = FourDoubles{m * d[i], m * d[g.nodes + i], m * d[2 * g.nodes + i]};
        nodes.node[count++] = i;
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

// Moves the centres to the means of their cells.
static void improve(Nodes &nodes, float steps, std::vector<Four> &centres, std::vector<FourDoubles> &sums) {
    assign(nodes, centres);
    std::fill(sums.begin(), sums.end(), FourDoubles{});
    for (int64_t i = 0; i < nodes.count; ++i) sums[nodes.cell[i] * SETS + i % SETS] += nodes.moment[i];
    for (size_t k = 0; k < centres.size(); ++k) {
        FourDoubles s = {};
        for (int set = 0; set < SETS; ++set) s += sums[k * SETS + set];
        const double length = std::sqrt(s[0] * s[0] + s[1] * s[1] + s[2] * s[2]);
        if (length > 0)
            for (int c = 0; c < 3; ++c) centres[k][c] = std::nearbyint(s[c] * (steps / length));
    }
}

// What each cell reflects: first moments, and sums.
static void add(const CellSums &g, int64_t tilt, int64_t row, const Nodes &nodes) {
    const float *d = g.mirrored + tilt * 3 * g.nodes, *c = g.reflected + row * 3 * g.nodes;
    float *out = g.out + row * g.cells * 6;
    std::fill(out, out + g.cells * 6, 0.0f);
    for (int64_t i = 0; i < nodes.count; ++i) {
        const int64_t at = nodes.node[i];
        const float *own = c + 3 * at, mass = own[0] + own[1] + own[2];
        float *sum = out + 6 * nodes.cell[i];
        for (int k = 0; k < 3; ++k) sum[k] += mass * d[k * g.nodes + at], sum[3 + k] += own[k];
    }
}

extern "C" int32_t ptt_cell_sums(const CellSums *g) {
    in_parallel(g->turns, g->threads, [=](int64_t turn) {
        Nodes nodes(g->nodes);
        std::vector<Four> centres(g->cells);
        std::vector<FourDoubles> sums(g->cells * SETS);
        for (int64_t k = 0; k < g->cells; ++k) {
            const float *p = g->centres + 3 * (turn * g->cells + k);
            centres[k] = Four{p[0], p[1], p[2]};
        }
        for (int64_t tilt = g->tilts - 1; tilt >= 0; --tilt) {
            const int64_t row = turn * g->tilts + tilt;
            take(*g, tilt, row, nodes);
            for (int i = tilt == g->tilts - 1 ? g->first : g->rounds; i > 0; --i)
                improve(nodes, g->steps, centres, sums);
            assign(nodes, centres);
            add(*g, tilt, row, nodes);
        }
    });
    return DONE;
}
