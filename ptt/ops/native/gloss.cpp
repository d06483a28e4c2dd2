// Glossy reflection of ptt/ops/gloss.py and around.py in one pass over the points (float32, isotropic, three channels):
//
//     B[v, c] = sum over n of  w_n[c](wo) (V_v(a_n, s_n) E[c](a_n, s_n) + (1 - V_v(a_n, s_n)) B[y_n, c])
//             + sum over m of  f[c](d_m, wo) cos(d_m) V_vm P_m[c]
//
// Points go LANES at a time, one in each lane of a vector; light and f, which each point reads in places of its own,
// are summed point by point. `look` mixes the rows of the table and finds where the lobes of a group lie, `see` how
// much of the sky they see; `reflect` and `lamp` sum, of one group while memory answers for the next. Indices are
// clamped, so that no input reads out of bounds.

#include "hemispheres.h"

constexpr float CLEAR = 1.0f / 512;  // a lobe of which less is hidden meets nothing: half of what a byte resolves
constexpr int AHEAD = 2;     // groups, of which what is seen is fetched
constexpr int TOGETHER = 8;  // lobes of which other points are found
constexpr int COLUMNS = 7;   // of a lobe: along, across, mirror, level, and w of each channel
constexpr float HALF_TURN = 3.14159265f;
constexpr int RING = 3 * SECTORS, WHOLE = RINGS * RING;  // numbers of f

// Of a lobe of a group of points
struct Lobe {
    Lanes local[3];     // its axis
    Lanes a, b, level;  // where that lies on maps of the hemisphere, and how wide it is
    Lanes seen;         // the share of it that is seen
    Ints first;         // number of the maps of light, and how far on to the right, down, and to the next level
    Lanes x, y, next;
    Lanes dark[3];      // the mean direction of what is hidden, and where that lies on maps of the hemisphere
    Lanes dark_a, dark_b;
    Ints pair, second;  // words of two cells of what else is seen, and which of the two
};

// Of a group of points: which the eye sees (`faces_eye`), and whether any; the local direction to it, and unit (u, v)
// along it as seen from above; the row of tables below it, and the share of the row above; of anisotropic f, the
// first rows of two azimuths, and the share of the next.
struct Stand {
    Ints seen;
    bool some;
    Lanes wo[3], u, v, frame[3][3], share, onward;
    Ints row, turn, next;
};

// Of the same: how much there is of the material, channel by channel, none where it is not seen; from local directions
// to those of the maps of light; its lobes.
struct Look : Stand {
    Lanes material[3], to_map[3][3];
    Corner corners[CORNERS];
    Lobe lobes[MOST_CELLS];
    float rows[LANES][COLUMNS * MOST_CELLS + GROUP];
};

// The local axis of a row (along, across, mirror) of a table, for directions wo, and unit (u, v) along them.
static inline void axis_of(const Lanes *row, const Lanes *wo, Lanes u, Lanes v, Lanes *local) {
    const Lanes x = wo[0], y = wo[1], z = size(wo[2]), flat = row[0] * z;
    local[0] = flat * u - row[1] * v - row[2] * x;
    local[1] = flat * v + row[1] * u - row[2] * y;
    local[2] = row[0] * (x * u + y * v) + row[2] * z;
}

// Unit (u, v) along directions as seen from above; those of one that is the normal are (1, 0).
static inline void flattened(const Lanes *wo, Lanes &u, Lanes &v) {
    const Lanes s = root(wo[0] * wo[0] + wo[1] * wo[1]);
    u = s < HEAD_ON ? all(1) : wo[0] / most(s, all(HEAD_ON));
    v = s < HEAD_ON ? all(0) : wo[1] / most(s, all(HEAD_ON));
}

static inline void find(const Look &at, int k, Lobe &lobe) {
    Lanes row[4];  // along, across, mirror, level
    gather_four(at.rows[0] + COLUMNS * k, lane() * (int)(sizeof *at.rows / sizeof **at.rows), row);
    axis_of(row, at.wo, at.u, at.v, lobe.local);
    hemi_octahedral(lobe.local, lobe.a, lobe.b), lobe.level = row[3];
}

// A local direction where the rows of a frame lie.
static inline void framed(const Lanes *x, const Lanes (&frame)[3][3], Lanes *out) {
    for (int c = 0; c < 3; ++c) out[c] = x[0] * frame[0][c] + x[1] * frame[1][c] + x[2] * frame[2][c];
}

// Finds the light of a lobe, of which a part is seen, about that part's mean direction.
static inline void find_light(const Shine &g, const Look &at, const Share &part, Lanes along, Lobe &lobe) {
    Lanes local[3], d[3];
    for (int r = 0; r < 3; ++r) local[r] = lobe.local[r] + along * part.gradient[r];
    framed(local, at.to_map, d);
    const Place on = place_on_sphere(d, g.map);
    const Ints below = clamp(whole(lobe.level), LEVELS - 2);
    lobe.next = lobe.level - real(below);
    lobe.first = ((below * g.map + on.row) * g.map + on.column) * CHANNELS, lobe.x = on.x, lobe.y = on.y;
}

// Asks for a part of what a group sees, all in order.
static inline void fetch(const Shine &g, int64_t v, int part, int parts) {
    const int size = Layout(g.bits).all, lines = size * LANES / LINE;
    for (int i = lines * part / parts; i < lines * (part + 1) / parts; ++i)
        __builtin_prefetch(g.seen + v * size + i * LINE, 0, 2);
}

// The angle of (x, y) from x on, in 0..2 pi.
static inline Lanes turned_by(Lanes y, Lanes x) {
    const Lanes a = angle(size(y), most(size(x), all(TINY))), half = x < 0 ? HALF_TURN - a : a;
    return y < 0 ? 2 * HALF_TURN - half : half;
}

template <class Points>
static inline void stand(const Points &g, int64_t v, Stand &at) {
    Lanes toward[3], length = all(0);
    for (int c = 0; c < 3; ++c) {
        toward[c] = g.distant ? load(g.eye + c * g.n + v) : g.eye[c] - load(g.position + c * g.n + v);
        length += toward[c] * toward[c];
    }
    const Lanes scale = 1.0f / root(most(length, all(TINY)));
    for (int r = 0; r < 3; ++r) {
        at.wo[r] = all(0);
        for (int c = 0; c < 3; ++c)
            at.wo[r] += (at.frame[r][c] = load(g.frame + (3 * r + c) * g.n + v)) * toward[c] * scale;
    }
    const Ints here = (at.wo[0] == 0) & (at.wo[1] == 0) & (at.wo[2] == 0);  // an eye in a point looks along its normal
    at.wo[2] = here ? all(1) : at.wo[2];
    at.seen = faces_eye(g, v, at.wo[2]), at.some = any(at.seen);
    if (!at.some) return;
    flattened(at.wo, at.u, at.v);
    const Lanes tilt = least(most(size(at.wo[2]) * (TILTS - 0.5f) - 0.5f, all(0)), all(TILTS - 1));
    at.row = clamp(whole(tilt), TILTS - 2), at.share = tilt - real(at.row);
    if (g.turns == 1) return;
    const Lanes azimuth = turned_by(at.v, at.u) * (0.5f * g.turns / HALF_TURN);
    const Ints before = clamp(whole(azimuth), g.turns - 1), after = before + 1;
    at.turn = TILTS * before, at.next = after == g.turns ? Ints{} : TILTS * after;
    at.onward = azimuth - real(before);
}

// What lies between a row and the one after it.
static inline void mix_rows(const float *below, float share, int columns, float *out) {
    for (int i = 0; i < columns; ++i) out[i] = below[i] + share * (below[columns + i] - below[i]);
}

static inline void look(const Shine &g, int64_t v, Look &at) {
    for (int r = 0; r < 3; ++r) turned(at.frame[r], g.turn, at.to_map[r]);
    for (int j = 0; j < g.each; ++j) {
        const Ints row = (Ints)gather((const float *)g.rows + v * g.each + j, g.each * lane());
        Corner &corner = at.corners[j];
        corner.from = row * Layout(g.bits).all, corner.weight = gather(g.weights + v * g.each + j, g.each * lane());
        frames_at(g.places, row, corner.frame);
    }
    const int columns = COLUMNS * g.lobes;
    for (int l = 0; l < LANES; ++l) {
        mix_rows(g.table + at.row[l] * columns, at.share[l], columns, at.rows[l]);
        if (g.turns == 1) continue;
        float next[COLUMNS * MOST_CELLS];
        mix_rows(g.table + (at.row[l] + at.turn[l]) * columns, at.share[l], columns, at.rows[l]);
        mix_rows(g.table + (at.row[l] + at.next[l]) * columns, at.share[l], columns, next);
        for (int i = 0; i < columns; ++i) at.rows[l][i] += at.onward[l] * (next[i] - at.rows[l][i]);
    }
    for (int k = 0; k < g.lobes; ++k) find(at, k, at.lobes[k]);
}

// Light E about directions in the frame of the map, of the nearest of the widths (ptt.ops.view.blurred)
static inline void light_at(const float *maps, int map, const Lanes *d, Ints level, Lanes *out) {
    const Place on = place_on_sphere(d, map);
    const Ints first = ((level * map + on.row) * map + on.column) * CHANNELS;
    Lanes corner[4][4];
    for (int j = 0; j < 4; ++j) gather_four(maps + ((j >> 1) * map + (j & 1)) * CHANNELS, first, corner[j]);
    for (int c = 0; c < 3; ++c) {
        const Lanes e[4] = {corner[0][c], corner[1][c], corner[2][c], corner[3][c]};
        out[c] = blend(e, on.x, on.y);
    }
}

// What comes of lamps in lobes about axes in the world, of points that are rows of `near_through`
// (ptt.ops.around._as_one_lobe)
static inline void lamps_in(const Shine &g, const Lanes *axis, Ints level, Ints row, Lanes *e) {
    const Lanes about = 1.0f / ((Lanes)((126 + level) << 23) / g.sharpness + g.blur), peak = about * 0.159154943f;
    for (int64_t m = 0; m < g.near_sources; ++m) {
        const float *d = g.near + 3 * m, *power = g.near_powers + 3 * m;
        const Lanes cosine = axis[0] * d[0] + axis[1] * d[1] + axis[2] * d[2];
        const Lanes seen = gather(g.near_through + m, row * (int)g.near_sources);
        const Lanes lobe = peak * exponential(least(about * (cosine - 1.0f), all(0))) * seen;
        for (int c = 0; c < 3; ++c) e[c] += lobe * power[c];
    }
}

// Asks for what lies at some bytes from p.
static inline void ask(const void *p, Ints offset) {
    int32_t i[LANES];
    std::memcpy(i, &offset, sizeof i);
    for (int32_t o : i) __builtin_prefetch((const char *)p + o);
}

// Where what is met lies about axes on maps of the hemisphere: the first word of the pair of cells, and which of it.
static inline void cell_of(Lanes a, Lanes b, Ints &pair, Ints &second) {
    const Ints column = clamp(whole((a + 1.0f) * (0.5f * MEETS)), MEETS - 1);
    const Ints row = clamp(whole((b + 1.0f) * (0.5f * MEETS)), MEETS - 1);
    pair = (row * MEETS + column) / 2 * 3, second = column & 1;
}

// What a group sees of a lobe, between places (ptt.ops.hemispheres.split_between).
static inline Share share_between(const Shine &g, const Look &at, const Lobe &lobe) {
    const Layout of(g.bits);
    Lanes d[3], gradient[3] = {}, counts = all(0);
    Share total = {all(0), all(0), {}};
    framed(lobe.local, at.frame, d);
    for (int j = 0; j < g.each; ++j) {
        const Corner &corner = at.corners[j];
        Lanes height, local[3], a, b;
        const Lanes weight = corner.weight * risen(corner.frame + 6, d, g.rise, height), *frame = corner.frame;
        if (!any(weight > 0)) continue;
        local_at(frame, d, height, local), hemi_octahedral(local, a, b);
        const Share own = share_of(g.seen, of, corner.from, local, a, b, lobe.level);
        total.seen += weight * own.seen, total.smooth += weight * own.smooth, counts += weight;
        for (int c = 0; c < 3; ++c)
            gradient[c] += weight * (own.gradient[0] * frame[c] + own.gradient[1] * frame[3 + c] +
                                     own.gradient[2] * frame[6 + c]);
    }
    const Lanes scale = 1.0f / most(counts, all(TINY));
    total.seen *= scale, total.smooth *= scale;
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) total.gradient[r] += scale * at.frame[r][c] * gradient[c];
    return total;
}

// What a group sees by each lobe: how much of the sky, and its light; asks for what hides the rest.
static inline void see(const Shine &g, int64_t v, int64_t later, Look &at) {
    const Layout of(g.bits);
    for (int k = 0; k < g.lobes; ++k) {
        Lobe &lobe = at.lobes[k];
        if (!g.each) fetch(g, later, k, g.lobes);
        const uint8_t *own = g.seen + v * of.all;
        const Share share = g.each ? share_between(g, at, lobe)
                                   : share_of(own, of, lane() * of.all, lobe.local, lobe.a, lobe.b, lobe.level);
        Lanes to_seen, to_hidden;
        parts_of(share, lobe.level, g.sharpness, to_seen, to_hidden);
        find_light(g, at, share, to_seen, lobe);
        lobe.seen = share.seen;
        if (!g.meets || !any((1.0f - lobe.seen > CLEAR) & (lobe.level < g.alone + 1))) continue;
        for (int r = 0; r < 3; ++r) lobe.dark[r] = lobe.local[r] - to_hidden * share.gradient[r];
        hemi_octahedral(lobe.dark, lobe.dark_a, lobe.dark_b);
        cell_of(lobe.dark_a, lobe.dark_b, lobe.pair, lobe.second);
        lobe.pair += lane() * MET;
        ask(g.meets + v * MET, 4 * lobe.pair);
    }
}

// Points that a group sees: which are there and face it, and where none is met at all; their normals in the world, and
// unit directions from them to the group.
struct Met {
    Ints there, none, point;
    Lanes normal[3], wo[3];
};

// The unit normal of cells, 0 where nothing is met (ptt.ops.around._normals).
static inline void normal_of(const int32_t *meets, Ints pair, Ints second, Lanes *normal) {
    const Ints word = (Ints)gather((const float *)meets + 2, pair) >> 16 * second;
    const Ints i = word << 24 >> 24, j = word << 16 >> 24;
    const Lanes a = real(i) * (1.0f / NORMAL), b = real(j) * (1.0f / NORMAL), z = 1.0f - size(a) - size(b);
    const Lanes x = z < 0 ? signed_as(1.0f - size(b), a) : a, y = z < 0 ? signed_as(1.0f - size(a), b) : b;
    const Lanes scale = i == NOTHING ? all(0) : 1.0f / root(x * x + y * y + z * z);
    normal[0] = x * scale, normal[1] = y * scale, normal[2] = z * scale;
}

// The same, bilinear between the cells about (a, b) across which no edge lies (ptt.ops.around._between_normals).
static inline void between_normals(const int32_t *meets, Ints from, Lanes a, Lanes b, Lanes *normal) {
    const Place p = place(a, b, MEETS);
    const Lanes left = 1.0f - p.x, above = 1.0f - p.y;
    const Lanes weight[4] = {left * above, p.x * above, left * p.y, p.x * p.y};
    Lanes corner[4][3], nearest[3], mean[3] = {};
    for (int k = 0; k < 4; ++k) {
        const Ints column = p.column + (k & 1), cell = (p.row + (k >> 1)) * MEETS + column;
        normal_of(meets, from + cell / 2 * 3, column & 1, corner[k]);
    }
    for (int c = 0; c < 3; ++c) {
        const Lanes upper = p.x > left ? corner[1][c] : corner[0][c], lower = p.x > left ? corner[3][c] : corner[2][c];
        nearest[c] = p.y > above ? lower : upper;
    }
    for (int k = 0; k < 4; ++k) {
        const Lanes *n = corner[k], cosine = n[0] * nearest[0] + n[1] * nearest[1] + n[2] * nearest[2];
        for (int c = 0; c < 3; ++c) mean[c] += cosine > EDGE ? weight[k] * n[c] : all(0);
    }
    const Lanes length = root(mean[0] * mean[0] + mean[1] * mean[1] + mean[2] * mean[2]);
    for (int c = 0; c < 3; ++c) normal[c] = mean[c] / most(length, all(TINY));
}

// A lobe by which a group of met points reflects: where its axis lies on maps of the hemisphere, the axis, local and in
// the world, w of each channel, and its level.
struct Part {
    Lanes a, b, local[3], axis[3], w[3];
    Ints level;
};

// What it sees of the sky: how much, and the mean direction of that.
struct Sky {
    Lanes through, axis[3];
};

// Of met points: their rows of what all see and of tables, and unit frames, rows in the world.
struct Records {
    Lanes frame[9];
    Ints row, table;
};

// (ptt.ops.around._rows)
static inline void records_of(const Shine &g, const Met &met, Records &of) {
    Lanes record[12];
    for (int i = 0; i < 12; i += 4) gather_four(g.records + i, met.point * RECORD, record + i);
    for (int i = 0; i < 9; ++i) of.frame[i] = record[i];
    const Lanes cosine = met.normal[0] * met.wo[0] + met.normal[1] * met.wo[1] + met.normal[2] * met.wo[2];
    const Lanes tilt = least(most(cosine * (TILTS - 0.5f) - 0.5f, all(0)), all(TILTS - 1));
    of.row = whole(record[9]), of.table = whole(tilt + 0.5f) + whole(record[10]);
}

// A lobe of a row of a table (ptt.ops.around._reflected).
static inline void part_of(const Shine &g, const Met &met, const Records &of, const float *tables, Ints at, Part &p) {
    Lanes t[8], flat[3], across[3], square = all(0), cosine = all(0);
    for (int i = 0; i < 8; i += 4) gather_four(tables + i, at, t + i);
    const Lanes *n = met.normal;
    for (int c = 0; c < 3; ++c) cosine += n[c] * met.wo[c];
    for (int c = 0; c < 3; ++c) flat[c] = met.wo[c] - cosine * n[c], square += flat[c] * flat[c];
    const Lanes sine = root(most(square, all(HEAD_ON * HEAD_ON)));
    for (int c = 0; c < 3; ++c)
        across[c] = (n[(c + 1) % 3] * flat[(c + 2) % 3] - n[(c + 2) % 3] * flat[(c + 1) % 3]) / sine;
    const Lanes of_flat = t[0] * cosine / sine - t[2], of_normal = t[0] * sine + t[2] * cosine;
    for (int c = 0; c < 3; ++c) p.axis[c] = of_flat * flat[c] + t[1] * across[c] + of_normal * n[c], p.w[c] = t[4 + c];
    for (int r = 0; r < 3; ++r)
        p.local[r] = of.frame[3 * r] * p.axis[0] + of.frame[3 * r + 1] * p.axis[1] + of.frame[3 * r + 2] * p.axis[2];
    hemi_octahedral(p.local, p.a, p.b);
    p.level = clamp(whole(t[3] + 0.5f), LEVELS - 1);
    const Layout seen(g.bits);
    const Ints first = of.row * seen.all;
    if (any(p.level < 5)) ask(g.all_seen, first + place(p.a, p.b, g.bits).row * (g.bits / 8));
    if (any((p.level > 1) & (p.level < 7)))
        ask(g.all_seen, first + seen.wide + place(p.a, p.b, WIDE_SIDE).row * WIDE_SIDE);
    if (any(p.level > 5)) ask(g.all_seen, first + seen.widest);
}

// What a lobe of met points sees of the sky.
static inline Sky sky_of(const Shine &g, const Records &of, const Part &p) {
    const Layout layout(g.bits);
    const Share share = share_of(g.all_seen, layout, of.row * layout.all, p.local, p.a, p.b, real(p.level));
    Sky sky = {p.local[2] > 0 ? share.seen : all(0), {p.axis[0], p.axis[1], p.axis[2]}};
    Lanes to_seen, to_hidden;
    parts_of(share, real(p.level), g.sharpness, to_seen, to_hidden);
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) sky.axis[c] += to_seen * share.gradient[r] * of.frame[3 * r + c];
    return sky;
}

// Adds what a lobe reflects, of the sky and of surfaces that send some light.
static inline void reflect_part(
    const Shine &g, const Records &of, const Part &p, const Sky &sky, const Lanes *surfaces, Lanes *out) {
    Lanes d[3], e[3];
    turned(sky.axis, g.turn, d);
    light_at(g.rest, g.map, d, p.level, e);
    for (int c = 0; c < 3; ++c) e[c] = surfaces[c] + sky.through * (e[c] - surfaces[c]);
    lamps_in(g, p.axis, p.level, of.row, e);
    for (int c = 0; c < 3; ++c) out[c] += p.w[c] * e[c];
}

// What a group sees about the axis of a lobe of other points, step by step as memory gives it: as one lobe, and how far
// it counts as a few.
struct Others {
    const Lobe *lobe;
    int number;
    Lanes hidden, spread, close, world[3];
    Met met;
    Records of;
    Part whole;
};

// Which points are met about axes, and which of them face away (ptt.ops.around._met).
static inline void meet(const int32_t *meets, Ints at, const Lanes *axis, Ints wanted, Met &met) {
    met.point = (Ints)gather((const float *)meets, at);
    Lanes cosine = all(0);
    for (int c = 0; c < 3; ++c) met.wo[c] = -axis[c], cosine += met.wo[c] * met.normal[c];
    met.none = met.point < 0;
    met.there = wanted & ~met.none & (cosine > 0);
    met.point = met.there ? met.point : Ints{};
}

static inline void find_others(const Shine &g, int64_t v, const Look &at, Others &o) {
    o.spread = least(most(o.lobe->level - g.alone, all(0)), all(1));
    o.met.there = (o.hidden > CLEAR) & (o.spread < 1), o.met.none = Ints{};
    if (!any(o.met.there)) return;
    framed(o.lobe->dark, at.frame, o.world);
    const Lanes length = root(o.world[0] * o.world[0] + o.world[1] * o.world[1] + o.world[2] * o.world[2]);
    for (int c = 0; c < 3; ++c) o.world[c] /= most(length, all(TINY));
    const int32_t *from = g.meets + v * MET;
    normal_of(from, o.lobe->pair, o.lobe->second, o.met.normal);
    meet(from, o.lobe->pair + o.lobe->second, o.world, o.met.there, o.met);
    ask(g.records, 4 * RECORD * o.met.point), ask(g.sent, 4 * SENT * o.met.point);
}

static inline void face(const Shine &g, Others &o) {
    if (!any(o.met.there)) return;
    records_of(g, o.met, o.of);
    part_of(g, o.met, o.of, g.tables, o.of.table * ROW, o.whole);
}

// What points that a lobe of met points sees send to these (ptt.ops.around._as_parts).
static inline void beyond(const Shine &g, const Records &of, const Part &p, Lanes through, Ints wanted, Lanes *out) {
    for (int c = 0; c < 3; ++c) out[c] = all(0);
    wanted &= 1.0f - through > CLEAR;
    if (!any(wanted)) return;
    Met met;
    Records own;
    Part whole;
    Ints pair, second;
    Lanes axis[3], sent[12], none[3] = {};
    const Lanes length = root(p.axis[0] * p.axis[0] + p.axis[1] * p.axis[1] + p.axis[2] * p.axis[2]);
    for (int c = 0; c < 3; ++c) axis[c] = p.axis[c] / most(length, all(TINY));
    cell_of(p.a, p.b, pair, second);
    pair += of.row * MET;
    normal_of(g.others, pair, second, met.normal);
    meet(g.others, pair + second, axis, wanted, met);
    if (!any(met.there)) return;
    records_of(g, met, own);
    part_of(g, met, own, g.tables, own.table * ROW, whole);
    for (int i = 4; i < 12; i += 4) gather_four(g.sent + i, met.point * SENT, sent + i);
    for (int c = 0; c < 3; ++c) out[c] = sent[6 + c];
    reflect_part(g, own, whole, sky_of(g, own, whole), none, out);
    for (int c = 0; c < 3; ++c) out[c] = met.there ? out[c] : all(0);
}

// Pairs of a point of a group and a lobe of which what is seen reflects as a few lobes, side by side: where the lobe
// lies on maps of the hemisphere, its axis in the world, how much it counts, channel by channel, the words of what the
// point meets and of the pair of cells there, which of these two, and the point.
struct Pairs {
    alignas(64) float a[LANES], b[LANES], world[3][LANES], weight[3][LANES];
    alignas(64) int32_t from[LANES], pair[LANES], second[LANES];
    int point[LANES], count = 0;
};

// What pairs add to the sums of their points (ptt.ops.around._as_parts); leaves none.
static inline void take_parts(const Shine &g, int64_t v, Pairs &pairs, float (*sums)[LANES]) {
    Met met;
    Records of;
    Lanes sent[4], world[3], out[3] = {};
    Ints from, pair, second;
    std::memcpy(&from, pairs.from, sizeof from), std::memcpy(&pair, pairs.pair, sizeof pair);
    std::memcpy(&second, pairs.second, sizeof second);
    for (int c = 0; c < 3; ++c) world[c] = load(pairs.world[c]);
    const int32_t *meets = g.meets + v * MET;
    between_normals(meets, from, load(pairs.a), load(pairs.b), met.normal);
    meet(meets, pair + second, world, lane() < pairs.count, met);
    if (any(met.there)) {
        records_of(g, met, of);
        gather_four(g.sent, met.point * SENT, sent);
        for (int c = 0; c < 3; ++c) out[c] = sent[c];
        Part parts[PARTS];
        for (int j = 0; j < PARTS; ++j) part_of(g, met, of, g.parts, (of.table * PARTS + j) * ROW, parts[j]);
        for (int j = 0; j < PARTS; ++j) {
            Lanes surfaces[3];
            const Sky sky = sky_of(g, of, parts[j]);
            beyond(g, of, parts[j], sky.through, met.there, surfaces);
            reflect_part(g, of, parts[j], sky, surfaces, out);
        }
    }
    for (int c = 0; c < 3; ++c) {
        const float *mean = g.mean + c * g.n + v;
        for (int i = 0; i < pairs.count; ++i) {
            const int point = pairs.point[i];
            sums[c][point] += pairs.weight[c][i] * (met.there[i] ? out[c][i] : met.none[i] ? mean[point] : 0);
        }
    }
    pairs.count = 0;
}

// What others send against the axis as one lobe, the mean of all where none is met, times the share that is hidden
// from the sky (ptt.ops.around.from_points)
static inline void take_from(const Shine &g, int64_t v, const Others &o, Lanes *out) {
    if (any(o.met.there & (o.close < 1))) {
        Lanes sent[8];
        for (int i = 0; i < 8; i += 4) gather_four(g.sent + i, o.met.point * SENT, sent + i);
        for (int c = 0; c < 3; ++c) out[c] = sent[c];
        reflect_part(g, o.of, o.whole, sky_of(g, o.of, o.whole), sent + 3, out);
    } else
        for (int c = 0; c < 3; ++c) out[c] = all(0);
    const Lanes share = (1.0f - o.spread) * (1.0f - o.close);
    for (int c = 0; c < 3; ++c) {
        const Lanes mean = load(g.mean + c * g.n + v), one = o.met.there ? out[c] : o.met.none ? mean : all(0);
        out[c] = o.hidden > CLEAR ? o.hidden * (share * one + o.spread * mean) : all(0);
    }
}

// Puts pairs of a lobe beside the others; takes them when there are LANES.
static inline void pair_up(
    const Shine &g, int64_t v, const Others &o, const Lanes *w, Pairs &pairs, float (*sums)[LANES]) {
    alignas(64) float a[LANES], b[LANES], world[3][LANES], weight[3][LANES], close[LANES];
    alignas(64) int32_t pair[LANES], second[LANES];
    const Lanes share = o.spread < 1 ? o.close * o.hidden * (1.0f - o.spread) : all(0);
    store(close, share), store(a, o.lobe->dark_a), store(b, o.lobe->dark_b);
    for (int c = 0; c < 3; ++c) store(world[c], o.world[c]), store(weight[c], share * w[c]);
    std::memcpy(pair, &o.lobe->pair, sizeof pair), std::memcpy(second, &o.lobe->second, sizeof second);
    for (int l = 0; l < LANES; ++l) {
        if (!(close[l] > 0)) continue;
        const int i = pairs.count++;
        pairs.a[i] = a[l], pairs.b[i] = b[l], pairs.pair[i] = pair[l], pairs.second[i] = second[l];
        for (int c = 0; c < 3; ++c) pairs.world[c][i] = world[c][l], pairs.weight[c][i] = weight[c][l];
        pairs.from[i] = l * MET, pairs.point[i] = l;
        if (pairs.count == LANES) take_parts(g, v, pairs, sums);
    }
}

// What comes of other points in all lobes, in sums; some lobes at a time, so that what one waits for comes while others
// are worked out.
static inline void from_points(const Shine &g, int64_t v, const Look &at, Lanes *sums) {
    constexpr int step = sizeof *at.rows / sizeof **at.rows;
    Lanes weights[MOST_CELLS][4];
    for (int k = 0; k < g.lobes; ++k) gather_four(at.rows[0] + COLUMNS * k + 3, lane() * step, weights[k]);
    Others others[TOGETHER];
    Pairs pairs = {};
    alignas(64) float closely[3][LANES] = {};
    for (int next = 0; next < g.lobes;) {
        int count = 0;
        for (; next < g.lobes && count < TOGETHER; ++next) {
            const Lanes hidden = 1.0f - at.lobes[next].seen, *w = weights[next];
            if (!any(hidden > CLEAR)) continue;
            Others &o = others[count++];
            o.lobe = at.lobes + next, o.number = next, o.hidden = hidden;
            const Lanes much = (w[1] + w[2] + w[3]) * hidden * (1.0f / 3);
            const Lanes narrow = least(most(g.alone - o.lobe->level, all(0)), all(1));
            o.close = g.others ? narrow * least(most(much / g.close - 1.0f, all(0)), all(1)) : all(0);
        }
        for (int i = 0; i < count; ++i) find_others(g, v, at, others[i]);
        for (int i = 0; i < count; ++i) face(g, others[i]);
        for (int i = 0; i < count; ++i) {
            Lanes e[3];
            const Lanes *w = weights[others[i].number] + 1;
            take_from(g, v, others[i], e);
            for (int c = 0; c < 3; ++c) sums[c] += w[c] * e[c];
            if (any(others[i].close > 0)) pair_up(g, v, others[i], w, pairs, closely);
        }
    }
    if (pairs.count) take_parts(g, v, pairs, closely);
    for (int c = 0; c < 3; ++c) sums[c] += load(closely[c]);
}

// Two numbers of four channels, of which the second lies GAP further on, between those at p and those a step further
template <int GAP>
static inline void between(const float *p, int64_t step, float share, Eight &e) {
    Eight other;
    load_both<GAP>(p, e), load_both<GAP>(p + step, other);
    e += share * (other - e);
}

// What comes of lobes, in sums.
static inline void reflect(const Shine &g, int64_t v, const Look &at, float (*sums)[CHANNELS]) {
    const int64_t down = CHANNELS * g.map, up = down * g.map;
    alignas(64) int32_t first[MOST_CELLS][LANES];
    alignas(64) float share[MOST_CELLS][4][LANES];
    int lobes[MOST_CELLS], count = 0;
    Lanes others[3] = {};
    for (int k = 0; k < g.lobes; ++k) {
        const Lobe &lobe = at.lobes[k];
        if (!any(lobe.seen > 0)) continue;
        const Lanes right = lobe.seen * lobe.x;
        const Lanes shares[4] = {lobe.seen - right, right, lobe.y, lobe.next};
        std::memcpy(first[count], &lobe.first, sizeof *first), std::memcpy(share[count], shares, sizeof *share);
        lobes[count++] = k;
    }
    if (g.meets) from_points(g, v, at, others);
    for (int l = 0; l < LANES; ++l) {
        Eight sum = {};  // of left corners, then of right ones
        for (int k = 0; k < count; ++k) {
            const float *p = g.maps + first[k][l], left = share[k][0][l], right = share[k][1][l];
            const Eight shares = {left, left, left, left, right, right, right, right};
            Eight e, wider, w;
            between<CHANNELS>(p, down, share[k][2][l], e);
            between<CHANNELS>(p + up, down, share[k][2][l], wider);
            load_both<0>(at.rows[l] + COLUMNS * lobes[k] + 4, w);
            sum += shares * w * (e + share[k][3][l] * (wider - e));
        }
        Four halves[2];
        std::memcpy(halves, &sum, sizeof sum);
        halves[0] += halves[1] + Four{others[0][l], others[1][l], others[2][l]};
        std::memcpy(sums[l], halves, sizeof *halves);
    }
}

// A lamp as a group sees it: how much of it, by cosine, and where the half vector lies about the normal: the ring below
// and the share of the next, and its angle to the eye.
struct HalfVector {
    Lanes seen, share, angle;
    Ints ring;
};

template <class Lit>
static inline bool half_of(const Lit &g, int64_t v, const Stand &at, int64_t m, HalfVector &half) {
    const float *toward = g.lamps + 3 * m;
    Lanes wi[3];
    for (int r = 0; r < 3; ++r)
        wi[r] = at.frame[r][0] * toward[0] + at.frame[r][1] * toward[1] + at.frame[r][2] * toward[2];
    half.seen = most(wi[2], all(0)) * (g.through ? load(g.through + m * g.n + v) : all(1));
    if (!any(half.seen > 0)) return false;
    const Lanes x = wi[0] + at.wo[0], y = wi[1] + at.wo[1], z = wi[2] + size(at.wo[2]);
    const Lanes square = most((x * x + y * y) / most(z * z, all(TINY)), all(TINY));
    const Ints octaves = (Ints)square - ((127 + SHARPEST) << 23);  // of which a float's bits are 2^-23 parts
    const Lanes ring = least(most(real(octaves) * 0x1p-21f - 0.5f, all(0)), all(RINGS - 1));
    half.ring = clamp(whole(ring), RINGS - 2), half.share = ring - real(half.ring);
    half.angle = turned_by(y * at.u - x * at.v, x * at.u + y * at.v);
    return true;
}

// What comes of a lamp by anisotropic f, of which the second half of a ring's sectors mirrors the first, added to sums.
template <class Lit>
static inline void lamp_around(const Lit &g, int64_t v, const Stand &at, int64_t m, float (*sums)[CHANNELS]) {
    constexpr int sectors = 2 * SECTORS;
    static_assert((sectors & (sectors - 1)) == 0, "sectors are counted by their bits");
    HalfVector half;
    if (!half_of(g, v, at, m, half)) return;
    const Lanes sector = half.angle * (SECTORS / HALF_TURN) + (sectors - 0.5f);
    const Ints left = whole(sector);
    const Lanes around = sector - real(left);
    Lanes root[3] = {};
    for (int k = 0; k < 16; ++k) {  // a row or the next, of tilts, azimuths, rings and sectors
        const Ints number = (left + (k & 1)) & (sectors - 1);
        const Ints place = number < SECTORS ? number : 3 * SECTORS - 1 - number;
        const Ints row = at.row + (k >> 3) + (k & 4 ? at.next : at.turn), ring = half.ring + (k >> 1 & 1);
        const Ints from = ((row * RINGS + ring) * sectors + place) * 3;
        const Lanes weight = (k & 1 ? around : 1 - around) * (k & 2 ? half.share : 1 - half.share) *
                             (k & 4 ? at.onward : 1 - at.onward) * (k & 8 ? at.share : 1 - at.share);
        for (int c = 0; c < 3; ++c) root[c] += weight * gather(g.values + c, from);
    }
    for (int c = 0; c < 3; ++c) {
        const Lanes sent = root[c] * root[c] * half.seen * g.powers[3 * m + c];
        for (int l = 0; l < LANES; ++l) sums[l][c] += sent[l];
    }
}

// What comes of a lamp, added to sums.
template <class Lit>
static inline void lamp(const Lit &g, int64_t v, const Stand &at, int64_t m, float (*sums)[CHANNELS]) {
    if (g.turns > 1) return lamp_around(g, v, at, m, sums);
    HalfVector half;
    if (!half_of(g, v, at, m, half)) return;
    alignas(64) float lit[LANES], along[LANES], around[LANES];
    alignas(64) int32_t first[LANES];
    const Lanes turn = half.angle > HALF_TURN ? 2 * HALF_TURN - half.angle : half.angle;
    const Lanes sector = least(most(turn * (SECTORS / HALF_TURN) - 0.5f, all(0)), all(SECTORS - 1));
    const Ints j = clamp(whole(sector), SECTORS - 2), from = at.row * WHOLE + half.ring * RING + j * 3;
    store(lit, half.seen), store(along, half.share), store(around, sector - real(j));
    std::memcpy(first, &from, sizeof first);
    const float *p = g.powers + 3 * m;
    const Four power = {p[0], p[1], p[2]};
    for (int l = 0; l < LANES; ++l) {
        Eight e, next;  // four numbers from the left sector's on, and the four that end with the right one's
        between<2>(g.values + first[l], RING, along[l], e);
        between<2>(g.values + first[l] + WHOLE, RING, along[l], next);
        e += at.share[l] * (next - e);
        const Four left = {e[0], e[1], e[2]}, right = {e[5], e[6], e[7]};
        const Four f = left + around[l] * (right - left);
        Four sum;
        std::memcpy(&sum, sums[l], sizeof sum);
        sum += f * f * (lit[l] * power);
        std::memcpy(sums[l], &sum, sizeof sum);
    }
}

// All that is done of a group before the light of the one before is summed, so that memory has time to answer.
static inline void begin(const Shine &g, int64_t v, int64_t later, Look &at) {
    stand(g, v, at);
    Ints some = {};
    for (int c = 0; c < 3; ++c) {
        at.material[c] = at.seen ? (g.share ? load(g.share + c * g.n + v) : all(1)) : all(0);
        some |= at.material[c] != 0;
    }
    at.some = any(some);
    if (at.some) look(g, v, at), see(g, v, later, at);
}

extern "C" int32_t ptt_shine(const Shine *given) {
    const Shine g = *given;
    if (g.lobes > MOST_CELLS) return UNKNOWN;
#pragma omp parallel num_threads(g.threads)
    by_parts(g.n / LANES, [&](int64_t first, int64_t end) {
        Look looks[2];
        begin(g, first * LANES, std::min(first + AHEAD, end - 1) * LANES, looks[first & 1]);
        for (int64_t i = first; i < end; ++i) {
            const Look &at = looks[i & 1];
            alignas(64) float sums[LANES][CHANNELS] = {};
            const int64_t next = i + 1, later = std::min(next + AHEAD, end - 1);
            if (next < end) begin(g, next * LANES, later * LANES, looks[next & 1]);
            if (at.some) {
                reflect(g, i * LANES, at, sums);
                for (int64_t m = 0; m < g.sources; ++m) lamp(g, i * LANES, at, m, sums);
            }
            for (int l = 0; l < LANES; ++l) {
                Four sent = {};
                for (int c = 0; c < 3; ++c) sent[c] = at.material[c][l] * sums[l][c];
                put_at(g, i * LANES + l, sent);
            }
        }
    });
    return DONE;
}

// ptt.ops.gloss.reflected_lamps
extern "C" int32_t ptt_reflected_lamps(const ReflectedLamps *given) {
    const ReflectedLamps g = *given;
    in_parallel(g.n / LANES, g.threads, [=](int64_t group) {
        Stand at;
        alignas(64) float sums[LANES][CHANNELS] = {};
        stand(g, group * LANES, at);
        for (int64_t m = 0; m < g.sources && at.some; ++m) lamp(g, group * LANES, at, m, sums);
        for (int l = 0; l < LANES; ++l)
            for (int c = 0; c < 3; ++c) sums[l][c] = at.seen[l] ? sums[l][c] : 0;
        for (int l = 0; l < LANES; ++l) std::memcpy(g.out + 3 * (group * LANES + l), sums[l], 3 * sizeof(float));
    });
    return DONE;
}

// ptt.ops.gloss.lamp_visibility
extern "C" int32_t ptt_lamp_visibility(const LampVisibility *given) {
    const LampVisibility g = *given;
    in_parallel(g.n / LANES, g.threads, [=](int64_t group) {
        const int64_t v = group * LANES;
        for (int64_t m = 0; m < g.sources; ++m) {
            Lanes sum = all(0);
            for (int64_t i = m * g.each; i < (m + 1) * g.each; ++i) {
                Ints word;
                std::memcpy(&word, g.visible + (g.cells[i] >> 5) * g.n + v, sizeof word);
                sum += g.shares[i] * real(word >> (int)((g.cells[i] & 31) ^ 7) & 1);
            }
            store(g.out + m * g.n + v, sum);
        }
    });
    return DONE;
}
