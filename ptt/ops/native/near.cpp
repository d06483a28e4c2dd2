// Lookups of ptt/ops/near.py, sixteen points at a time; the last ones overlap those before.

#include "lanes.h"

template <class Run>
static inline void by_lanes(int64_t points, int threads, Run run) {
    in_parallel((points + LANES - 1) / LANES, threads, [=](int64_t b) { run(std::min(b * LANES, points - LANES)); });
}

// rows, weights (p, 4)
static inline void put(const Corners &at, int32_t *rows, float *weights, int64_t p) {
    for (int l = 0; l < LANES; ++l)
        for (int k = 0; k < 4; ++k) rows[4 * (p + l) + k] = at.cell[k][l], weights[4 * (p + l) + k] = at.weight[k][l];
}

static inline Lanes dot(const Lanes *a, const Lanes *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// 0..1 of a whole turn, to 1e-4 of a radian
static inline Lanes turns(Lanes y, Lanes x) {
    const Lanes a = size(x), b = size(y), t = least(a, b) / most(most(a, b), all(TINY)), s = t * t;
    Lanes r = ((((0.0208351f * s - 0.0851330f) * s + 0.1801410f) * s - 0.3302995f) * s + 0.9998660f) * t;
    r = b > a ? 1.57079633f - r : r;
    r = x < 0 ? 3.14159265f - r : r;
    r = y < 0 ? -r : r;
    return r * 0.159154943f;
}

extern "C" int32_t ptt_near_frames(const NearFrames *g) {
    const float *frames = g->frames, *sampled = g->sampled;
    const bool between = g->between;  // rows, weights (points, 4, 2)
    int32_t *rows = g->rows;
    float *weights = g->weights;
    const int64_t n = g->n, twists = g->twists;
    const int32_t all_around = twists;
    by_lanes(g->points, g->threads, [=](int64_t p) {
        const float *first = frames + 9 * p;
        Lanes tangent[3], normal[3];
        for (int c = 0; c < 3; ++c) tangent[c] = gather(first + c, 9 * lane()), normal[c] = gather(first + 6 + c, 9 * lane());
        Corners at = on_sphere(normal, n);
        Lanes share[4];
        Ints next[4];
        for (int k = 0; k < 4; ++k) {
            Lanes own[3][3];
            for (int a = 0; a < 3; ++a)
                for (int c = 0; c < 3; ++c) own[a][c] = gather(sampled + 3 * a + c, 9 * at.cell[k]);
            // the tangent, leaned by the smallest rotation that takes the normal to the sampled one
            const Lanes lean = dot(tangent, own[2]) / most(1.0f + dot(normal, own[2]), all(1e-6f));
            const Lanes x = dot(tangent, own[0]) - lean * dot(normal, own[0]);
            const Lanes y = dot(tangent, own[1]) - lean * dot(normal, own[1]);
            // in 0..2 twists
            const Lanes turned = (turns(y, x) + 1.0f) * (float)twists + (between ? 0.0f : 0.5f);
            Ints turn = whole(turned), after = turn + 1;
            share[k] = turned - real(turn);
            turn = turn >= all_around ? turn - all_around : turn, after = after >= all_around ? after - all_around : after;
            turn = turn >= all_around ? turn - all_around : turn, after = after >= all_around ? after - all_around : after;
            next[k] = at.cell[k] * all_around + after, at.cell[k] = at.cell[k] * all_around + turn;
        }
        if (!between) return put(at, rows, weights, p);
        for (int l = 0; l < LANES; ++l)
            for (int k = 0; k < 4; ++k) {
                const int64_t i = 8 * (p + l) + 2 * k;
                rows[i] = at.cell[k][l], rows[i + 1] = next[k][l];
                weights[i + 1] = at.weight[k][l] * share[k][l], weights[i] = at.weight[k][l] - weights[i + 1];
            }
    });
    return DONE;
}

// toward the eye (3), or, where `positions` is null, in directions (points, 3)
extern "C" int32_t ptt_near_views(const NearViews *g) {
    const float *frames = g->frames, *positions = g->positions, *eye = g->eye;
    by_lanes(g->points, g->threads, [=](int64_t p) {
        Lanes away[3], local[3];
        for (int c = 0; c < 3; ++c)
            away[c] = positions ? eye[c] - gather(positions + 3 * p + c, 3 * lane()) : gather(eye + 3 * p + c, 3 * lane());
        for (int a = 0; a < 3; ++a) {
            Lanes row[3];
            for (int c = 0; c < 3; ++c) row[c] = gather(frames + 9 * p + 3 * a + c, 9 * lane());
            local[a] = dot(row, away);
        }
        const Lanes sum = size(local[0]) + size(local[1]) + size(local[2]);
        const Lanes scale = sum > 0 ? 1.0f / most(sum, all(TINY)) : Lanes{};
        put(corners((local[0] + local[1]) * scale, (local[0] - local[1]) * scale, g->views, false), g->rows, g->weights, p);
    });
    return DONE;
}

extern "C" int32_t ptt_near_texels(const NearTexels *g) {
    const float *corner_uv = g->corner_uv, *barycentric = g->barycentric;
    by_lanes(g->points, g->threads, [=](int64_t p) {
        Ints corner;
        for (int l = 0; l < LANES; ++l) corner[l] = (int32_t)g->triangle[p + l] * 6;
        Lanes u = {}, v = {};
        for (int c = 0; c < 3; ++c) {
            const Lanes share = gather(barycentric + 3 * p + c, 3 * lane());
            u += share * gather(corner_uv + 2 * c, corner), v += share * gather(corner_uv + 2 * c + 1, corner);
        }
        Corners at = corners(2.0f * u - 1.0f, 2.0f * v - 1.0f, g->side, false);
        for (Ints &cell : at.cell) cell = (Ints)gather((const float *)g->in_use, cell);
        put(at, g->rows, g->weights, p);
    });
    return DONE;
}
