// The view step of ptt/ops/view.py in one pass over the points (float32, isotropic lobes, three channels):
//
//     B[v, c] = sum over o of  V[o, wo] Q[c, o, v]
//             + specular[c] sum over k of  rho_k(wo) (E_k[c, mirror] cut_k[v, mirror]
//                                                     + sum over s of  z_k[s] Y_s(mirror) I[c, s, v])
//
// Points go LANES at a time, one in each lane of a vector. `look` finds where a group looks and fetches its words of
// the cuts ahead of time; `shade` sums, AHEAD groups later. Indices are clamped, so that no input reads out of bounds.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

#include <omp.h>

#if defined(__AVX512F__)
#include <immintrin.h>
constexpr int LANES = 16;
#elif defined(__AVX__)
constexpr int LANES = 8;
#else
constexpr int LANES = 4;
#endif
constexpr int AHEAD = 2;        // groups
constexpr int HARMONICS = 16;   // of order 4
constexpr float TINY = 1e-30f;

typedef float Lanes __attribute__((vector_size(4 * LANES)));
typedef int32_t Ints __attribute__((vector_size(4 * LANES)));

// As ptt/ops/native.py lays it out; shapes as ptt/ops/view.py documents them.
struct Arguments {
    const float *position, *frame, *eye, *outgoing, *sent, *rho, *specular, *maps, *turn, *blurs;
    const int32_t *cuts;
    const int64_t *which;
    float *out;
    int64_t blocks, width, rows;  // rows: of sent, 1 + o + s
    int32_t distant, factors, harmonics, tilts, disk, cells, map, threads;  // disk, cells, map: sides of grids
};

static inline Lanes load(const float *p) {
    Lanes x;
    std::memcpy(&x, p, sizeof x);
    return x;
}

static inline Lanes gather(const float *p, Ints index) {
#if defined(__AVX512F__)
    return _mm512_i32gather_ps((__m512i)index, p, 4);
#endif
    int32_t i[LANES];
    float x[LANES];
    std::memcpy(i, &index, sizeof i);
    for (int l = 0; l < LANES; ++l) x[l] = p[i[l]];
    return load(x);
}

// x[i] = p[index + i], i < 4
static inline void gather_four(const float *p, Ints index, Lanes *x) {
#if defined(__AVX512F__)
    int32_t i[LANES];
    std::memcpy(i, &index, sizeof i);
    __m512 r[4];
    for (int l = 0; l < 4; ++l) {
        r[l] = _mm512_castps128_ps512(_mm_loadu_ps(p + i[l]));
        r[l] = _mm512_insertf32x4(r[l], _mm_loadu_ps(p + i[4 + l]), 1);
        r[l] = _mm512_insertf32x4(r[l], _mm_loadu_ps(p + i[8 + l]), 2);
        r[l] = _mm512_insertf32x4(r[l], _mm_loadu_ps(p + i[12 + l]), 3);
    }
    const __m512d a = (__m512d)_mm512_unpacklo_ps(r[0], r[1]), b = (__m512d)_mm512_unpackhi_ps(r[0], r[1]);
    const __m512d c = (__m512d)_mm512_unpacklo_ps(r[2], r[3]), d = (__m512d)_mm512_unpackhi_ps(r[2], r[3]);
    x[0] = (Lanes)_mm512_unpacklo_pd(a, c), x[1] = (Lanes)_mm512_unpackhi_pd(a, c);
    x[2] = (Lanes)_mm512_unpacklo_pd(b, d), x[3] = (Lanes)_mm512_unpackhi_pd(b, d);
#else
    for (int i = 0; i < 4; ++i) x[i] = gather(p + i, index);
#endif
}

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

static inline Lanes root(Lanes v) {
    float x[LANES];
    std::memcpy(x, &v, sizeof x);
    for (int l = 0; l < LANES; ++l) x[l] = std::sqrt(x[l]);
    return load(x);
}

static inline Lanes all(float x) { return x - Lanes{}; }
static inline Ints lane() {
    Ints i;
    for (int l = 0; l < LANES; ++l) i[l] = l;
    return i;
}
static inline Lanes most(Lanes x, Lanes y) { return x > y ? x : y; }
static inline Lanes least(Lanes x, Lanes y) { return x < y ? x : y; }
static inline Ints clamp(Ints i, int last) {
    i = i < 0 ? Ints{} : i;
    return i > last ? last - Ints{} : i;
}
static inline Lanes size(Lanes x) { return (Lanes)((Ints)x & 0x7fffffff); }
static inline Lanes signed_as(Lanes x, Lanes sign) { return (Lanes)((Ints)size(x) | ((Ints)sign & INT32_MIN)); }
static inline Ints whole(Lanes x) { return __builtin_convertvector(x, Ints); }
static inline Lanes real(Ints i) { return __builtin_convertvector(i, Lanes); }

struct Corners {  // of a bilinear lookup
    Ints cell[4];
    Lanes weight[4];
};

// ptt.ops.octahedral.corners
static inline Corners corners(Lanes a, Lanes b, int n, bool wrap) {
    const float half = 0.5f * n;
    Lanes x = least(most((a + 1.0f) * half - 0.5f, all(-1)), all(n));
    Lanes y = least(most((b + 1.0f) * half - 0.5f, all(-1)), all(n));
    Ints column = whole(x + 1.0f) - 1, row = whole(y + 1.0f) - 1;  // floor
    x -= real(column), y -= real(row);
    Corners at;
    for (int j = 0; j < 4; ++j) {
        Ints r = row + (j >> 1), c = column + (j & 1);
        Ints i = r, k = c;
        if (wrap) {
            k = (r < 0) | (r >= n) ? n - 1 - c : c;
            i = (c < 0) | (c >= n) ? n - 1 - r : r;
        }
        at.cell[j] = clamp(i, n - 1) * n + clamp(k, n - 1);
        at.weight[j] = (j & 1 ? x : 1.0f - x) * (j >> 1 ? y : 1.0f - y);
    }
    return at;
}

// atan2(s, z) of s >= 0, and of max(z, 0): pi / 4 + atan((s - z) / (s + z)), to 1e-7 (Abramowitz and Stegun 4.4.49)
static inline Lanes angle(Lanes s, Lanes z) {
    z = most(z, Lanes{});
    Lanes t = (s - z) / most(s + z, all(TINY)), u = t * t, p = all(0.0028662257f);
    for (float a : {-0.0161657367f, 0.0429096138f, -0.0752896400f, 0.1065626393f, -0.1420889944f, 0.1999355085f,
                    -0.3333314528f, 1.0f})
        p = p * u + a;
    return p * t + 0.78539816f;
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

struct Look {  // of a group of points
    Lanes wo[3], axis[3];  // to the eye, local; the mirror direction, in the world
    Corners cut;
};

template <int K>
static inline void look(const Arguments &g, int64_t v, Look &at) {
    const int64_t n = g.blocks * g.width;
    Lanes toward[3], length = all(0);
    for (int c = 0; c < 3; ++c) {
        toward[c] = g.distant ? load(g.eye + c * n + v) : g.eye[c] - load(g.position + c * n + v);
        length += toward[c] * toward[c];
    }
    const Lanes scale = 1.0f / root(most(length, all(TINY)));
    if (!g.distant)
        for (auto &t : toward) t *= scale;
    Lanes normal[3];
    for (int r = 0; r < 3; ++r) {
        at.wo[r] = all(0);
        for (int c = 0; c < 3; ++c) at.wo[r] += (normal[c] = load(g.frame + (3 * r + c) * n + v)) * toward[c];
    }
    for (int c = 0; c < 3; ++c) at.axis[c] = 2.0f * at.wo[2] * normal[c] - toward[c];
    if (K == 0) return;
    Lanes x = -at.wo[0], y = -at.wo[1], flat = 1.0f / most(size(x) + size(y) + size(at.wo[2]), all(TINY));
    at.cut = corners((x + y) * flat, (x - y) * flat, g.cells, false);
    const int stride = g.cells * g.cells;
    for (int j = 0; j < 4; j += 2)
        for (int l = 0; l < LANES; ++l) __builtin_prefetch(g.cuts + (v + l) * stride + at.cut.cell[j][l]);
}

template <int K>
static inline void shade(const Arguments &g, int64_t v, const Look &at) {
    const int w = g.width, o = g.factors;
    const float *sent = g.sent + (v / w * 3 * g.rows) * w + v % w;
    const float *q[3] = {sent, sent + g.rows * w, sent + 2 * g.rows * w};
    const int64_t next = 3 * g.rows * w;
    const auto stream = [=](const float *p) {
        __builtin_prefetch(p + next);  // the next block's
        return load(p);
    };
    Lanes out[3] = {stream(q[0]), stream(q[1]), stream(q[2])};
    if (o > 1) {
        Corners on = corners(at.wo[0], at.wo[1], g.disk, false);
        for (auto &cell : on.cell) cell *= o - 1;
        mix(g.outgoing, o - 1, on.cell, on.weight, [&](int f, Lanes factor) {
            for (int c = 0; c < 3; ++c) out[c] += factor * stream(q[c] + (1 + f) * w);
        });
    }
    if constexpr (K > 0) {
        Lanes rho[K], x = -at.wo[0], y = -at.wo[1], z = size(at.wo[2]);
        Lanes tilt = angle(root(x * x + y * y), at.wo[2]) * (g.tilts * 0.63661977f) - 0.5f;
        tilt = least(most(tilt, all(0)), all(g.tilts - 1));
        Ints below = clamp(whole(tilt), std::max(g.tilts - 2, 0)), above = clamp(below + 1, g.tilts - 1);
        tilt -= real(below);
        Ints tilts[2] = {below * K, above * K};
        Lanes shares[2] = {1.0f - tilt, tilt};
        mix(g.rho, K, tilts, shares, [&](int k, Lanes r) { rho[k] = r; });

        Lanes cut[K] = {};  // cut_k: a byte of each word
        const int stride = g.cells * g.cells;
        for (int j = 0; j < 4; ++j) {
            Lanes bits = gather((const float *)g.cuts + v * stride, at.cut.cell[j] + lane() * stride);
            for (int k = 0; k < K; ++k) cut[k] += at.cut.weight[j] * real(((Ints)bits >> (8 * (int)g.which[k])) & 255);
        }

        Lanes d[3];  // the mirror direction on the map, turned with the light
        for (int c = 0; c < 3; ++c)
            d[c] = at.axis[0] * g.turn[c] + at.axis[1] * g.turn[3 + c] + at.axis[2] * g.turn[6 + c];
        Lanes scale = 1.0f / most(size(d[0]) + size(d[1]) + size(d[2]), all(TINY));
        for (auto &e : d) e *= scale;
        Lanes a = d[2] < 0 ? signed_as(1.0f - size(d[1]), d[0]) : d[0];
        Lanes b = d[2] < 0 ? signed_as(1.0f - size(d[0]), d[1]) : d[1];
        Corners on = corners(a, b, g.map, true);
        Lanes lit[3] = {};
        for (auto &cell : on.cell) cell *= 3 * K;
        Lanes light[3 * K];
        mix(g.maps, 3 * K, on.cell, on.weight, [&](int i, Lanes e) { light[i] = e; });
        for (int k = 0; k < K; ++k)
            for (int c = 0; c < 3; ++c) lit[c] += rho[k] * cut[k] * (1.0f / 255) * light[3 * k + c];
        if (g.harmonics) {
            Lanes basis[HARMONICS];
            harmonics(x, y, z, basis);
            for (int s = 0; s < HARMONICS; ++s) {
                Lanes blur = rho[0] * g.blurs[s];
                for (int k = 1; k < K; ++k) blur += rho[k] * g.blurs[k * HARMONICS + s];
                blur *= basis[s];
                for (int c = 0; c < 3; ++c) lit[c] += blur * stream(q[c] + (o + s) * w);
            }
        }
        for (int c = 0; c < 3; ++c) out[c] += lit[c] * g.specular[c];
    }
    for (int l = 0; l < LANES; ++l)
        for (int c = 0; c < 3; ++c) g.out[3 * (v + l) + c] = out[c][l];
}

template <int K>
static void run(const Arguments &g) {
    const int64_t groups = g.blocks * g.width / LANES;
#pragma omp parallel num_threads(g.threads)
    {
        const int64_t t = omp_get_thread_num(), of = omp_get_num_threads();
        const int64_t first = groups * t / of, end = groups * (t + 1) / of;
        Look at[AHEAD];
        for (int64_t i = first - AHEAD; i < end; ++i) {
            if (i >= first) shade<K>(g, i * LANES, at[(i + AHEAD) % AHEAD]);
            if (i + AHEAD < end) look<K>(g, (i + AHEAD) * LANES, at[(i + AHEAD) % AHEAD]);
        }
    }
}

// lobes: k, 0 to 4
extern "C" int ptt_view(const Arguments *g, int lobes) {
    switch (lobes) {
        case 0: run<0>(*g); return 0;
        case 1: run<1>(*g); return 0;
        case 2: run<2>(*g); return 0;
        case 3: run<3>(*g); return 0;
        case 4: run<4>(*g); return 0;
    }
    return 1;
}
