// How much of lamps is seen, by places and between them (ptt/ops/hemispheres.py).

#include "hemispheres.h"

// Of a group of lanes that ends at a count, the number of each, the last again beyond it.
static inline Ints numbers(int64_t first, int64_t count) { return clamp((int32_t)first + lane(), (int)count - 1); }

static inline void put(Lanes x, float *out, int64_t first, int64_t count) {
    float values[LANES];
    store(values, x);
    std::memcpy(out + first, values, sizeof(float) * std::min<int64_t>(LANES, count - first));
}

extern "C" int32_t ptt_lamps_seen(const LampsSeen *given) {
    const LampsSeen g = *given;
    const Layout of(g.bits);
    in_parallel((g.places + LANES - 1) / LANES, g.threads, [=](int64_t group) {
        const int64_t first = group * LANES;
        const Ints row = numbers(first, g.places);
        Lanes frame[9], height, local[3], a, b;
        frames_at(g.frames, row, frame);
        for (int64_t m = 0; m < g.sources; ++m) {
            Lanes sum = all(0);
            for (int64_t i = m * g.each; i < (m + 1) * g.each; ++i) {
                if (g.shares[i] == 0) continue;
                const Lanes d[3] = {all(g.areas[3 * i]), all(g.areas[3 * i + 1]), all(g.areas[3 * i + 2])};
                risen(frame + 6, d, 1, height);
                if (!any(height > 0)) continue;
                local_at(frame, d, height, local), hemi_octahedral(local, a, b);
                sum += height > 0 ? g.shares[i] * bits_at(g.seen, of.bits, row * of.all, a, b) : all(0);
            }
            put(sum, g.out + m * g.places, first, g.places);
        }
    });
    return DONE;
}

extern "C" int32_t ptt_lamps_between(const LampsBetween *given) {
    const LampsBetween g = *given;
    in_parallel((g.points + LANES - 1) / LANES, g.threads, [=](int64_t group) {
        const int64_t first = group * LANES;
        const Ints at = (int)g.each * numbers(first, g.points);
        Ints row[CORNERS];
        Lanes weight[CORNERS], normal[CORNERS][3];
        for (int j = 0; j < g.each; ++j) {
            row[j] = (Ints)gather((const float *)g.rows + j, at), weight[j] = gather(g.weights + j, at);
            for (int c = 0; c < 3; ++c) normal[j][c] = gather(g.frames + 6 + c, 9 * row[j]);
        }
        for (int64_t m = 0; m < g.sources; ++m) {
            const float *lamp = g.lamps + 3 * m;
            const Lanes d[3] = {all(lamp[0]), all(lamp[1]), all(lamp[2])};
            Lanes total = all(0), counts = all(0), height;
            for (int j = 0; j < g.each; ++j) {
                const Lanes share = weight[j] * risen(normal[j], d, g.rise, height);
                total += share * gather(g.through + m * g.places, row[j]), counts += share;
            }
            put(total / most(counts, all(TINY)), g.out + m * g.points, first, g.points);
        }
    });
    return DONE;
}
