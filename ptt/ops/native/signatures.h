// What each kernel takes: the one table of signatures. `kernels.py` reads the structures from here and makes those of
// ctypes of them, so that no side mirrors the other by hand. A kernel `ptt_name` takes one structure, `Name`, and returns
// DONE, or UNKNOWN where it has no case for what it was given. Shapes are those of the plain function of its name.

#pragma once
#include <cstdint>

#include "constants.h"

// The types of torch, by the numbers that arguments.py gives them.
struct Half {
    uint16_t bits;
};
struct BFloat {
    uint16_t bits;
};
enum Type { FLOAT32 = 0, FLOAT16 = 1, UINT8 = 2, BFLOAT16 = 3 };
enum Status { DONE = 0, UNKNOWN = 1 };

// ptt/ops/latlong.py

struct OctahedralMeans {
    const float *texels;             // (height, width, 3)
    float *even, *out;               // scratch (height + 2, width + 2, 4), and (n * n, 3)
    int64_t height, width, n;
    double arc;                      // of a texel's blur along its row, radians
    int32_t samples, threads;        // samples: along the edge of a cell
};

// ptt/ops/relight.py

struct Lighting {
    const float *fine, *turn, *directions, *shares;  // (side * side, 4), (3, 3), (4, 3, cells), (4, cells)
    float *out;                                      // (3, squares, n, n)
    int64_t side, squares, n;                        // squares * n * n is a multiple of GROUP
    int32_t threads;
};

struct LightEigen {
    const float *lighting;   // three channels of a cluster begin `channel` apart, those of the next `cluster` further
    const int64_t *columns;  // (clusters, rows): which of the lighting, or null for all in order
    const void *transfer;    // (clusters, rows, width) of a Type
    float *out;              // (clusters, 3, width)
    int64_t cluster, channel, rows, width, clusters;
    int32_t type, threads;
};

struct Exitant {
    const float *direct, *one, *two;                     // U0 (k, 3, e, i), U1 (k, 3, q, e, HARMONICS), U2 (k, 3, p, e)
    const float *h, *pairs;                              // H (q, 3), and its products (p, 3)
    const float *coupling, *to_factors, *to_harmonics;   // M (3, o, i), C (HARMONICS, i), (HARMONICS, HARMONICS)
    const float *weights;                                // (blocks, e, width)
    const int64_t *cluster;                              // (blocks)
    int16_t *out;                                        // (blocks * width / GROUP, 3, x + 1, GROUP)
    float *unit;                                         // of each row of a group: (blocks * width / GROUP, 3, x + 1)
    int64_t blocks, eigen, factors, slots, again, outgoing, x, width;  // again: pairs; x: o, or o + HARMONICS
    int32_t threads;
};

// ptt/ops/view.py

struct View {
    const float *position, *frame, *dip, *colour, *eye, *outgoing;
    const int16_t *values;
    const float *unit, *rho, *axes, *specular, *maps, *turn, *blurs;
    const int32_t *cuts, *point;           // point (blocks * width): row of `out`, -1 for none
    const int64_t *which;
    float *out;                            // (points, 3)
    int64_t blocks, width, rows, points;   // rows: of values, 1 + o + s + 1
    int32_t distant, factors, harmonics, lobes, tilts, disk, cells, map;  // disk, cells, map: sides of grids
    int32_t threads;
};

// ptt/ops/gloss.py

struct Shine {
    const float *position, *frame, *dip, *eye, *table, *values, *maps, *turn, *lamps, *powers;
    const float *through;                                 // (sources, n), how much of lamps is seen
    const float *share;                                   // null for all of the material everywhere
    const float *mean, *records, *sent, *tables, *parts, *rest;  // of what lies around
    const float *near, *near_powers, *near_through;       // of the same: lamps, and how much is seen (rows, near_sources)
    const float *weights, *places;                        // (n, each), and frames (places, 3, 3); null where each is 0
    const int32_t *rows;                                  // (n, each): of the places between which points lie
    const int32_t *meets, *others;                 // null where nothing does, and where light bounces once
    const uint8_t *seen, *all_seen;                // of each point bits, then bytes
    const int32_t *point;                          // (n): row of `out`, -1 for none
    float *out;                                    // (points, 3)
    int64_t n, points, sources, near_sources;  // sources: lamps
    float sharpness, blur;                     // of a lobe of level 1; of lobes in which others show lamps
    float alone, close;                        // of lobes that see one point alone; what these reflect of it as parts
    float rise;                                // over the sine of the height, how much a place counts
    int32_t distant, turns, lobes, map, each, bits;  // turns: 1 for isotropic f; map, bits: sides of maps
    int32_t threads;
};

struct ReflectedLamps {
    const float *position, *frame, *dip, *eye, *values, *lamps, *powers;
    const float *through;  // (sources, n), null where all of every lamp is seen
    float *out;            // (n, 3)
    int64_t n, sources;
    int32_t distant, turns, threads;
};

struct LampVisibility {
    const int32_t *visible;      // (words, n)
    const int64_t *cells;        // (sources, each)
    const float *shares;         // (sources, each)
    float *out;                  // (sources, n)
    int64_t n, sources, each;
    int32_t threads;
};

// ptt/ops/hemispheres.py

struct LampsSeen {
    const float *frames, *areas, *shares;  // (places, 3, 3), (sources, each, 3), (sources, each)
    const uint8_t *seen;                   // of each place bits, then bytes
    float *out;                            // (sources, places)
    int64_t places, sources, each;
    int32_t bits, threads;  // bits: the side of the map of bits
};

struct LampsBetween {
    const float *weights, *frames, *through, *lamps;  // (points, each), (places, 3, 3), (sources, places), (sources, 3)
    const int32_t *rows;                              // (points, each)
    float *out;                                       // (sources, points)
    int64_t points, places, sources, each;
    float rise;
    int32_t threads;
};

// ptt/ops/cells.py

struct CellSums {
    const float *mirrored, *whole;             // (tilts, 3, nodes); whole: whole numbers, steps to 1
    const float *mass, *reflected, *centres;   // (turns * tilts, nodes), (turns * tilts, nodes, 3), (turns, cells, 3)
    const int64_t *counts;                     // (sets): of cells in each set, `cells` in all
    float *out;                                // (turns * tilts, cells, 6)
    int64_t turns, tilts, nodes, sets, cells;
    int32_t first, rounds, steps, threads;  // first, rounds: of Lloyd's algorithm, at the first tilt and at the others
};

// ptt/ops/rotation.py

struct LocalLight {
    const float *source;    // (N, CHANNELS)
    const int64_t *starts;  // (frames * m * m + 1)
    const int32_t *reads;   // cell * 256 + count; the counts of a cell sum to 1 / unit
    float *out;             // (frames, m * m, CHANNELS)
    int64_t frames, m;
    float unit;
    int32_t threads;
};

struct ResampledLight {
    const float *source, *frames, *directions;  // (n * n, CHANNELS), (f, 3, 3), (3, padded)
    float *out;
    int64_t count, m, each, padded, n;  // each: samples of a cell
    int32_t threads;
};

struct ResampledValues {
    const float *source;
    const int64_t *starts;
    const int32_t *reads;
    void *values;  // (frames, 3, cells) of a Type
    float *scale;  // (frames)
    int64_t frames, cells;
    float unit, largest;  // largest: of a row as it is stored, 0 for as it is
    int32_t type, threads;
};

struct QuantisedRows {
    const int64_t *starts;  // of S (frames * m * m + 1)
    const int32_t *reads;
    const int32_t *at;  // basis functions of the source that differ from zero in each cell (cells, terms), their values
    const double *worth;
    const int64_t *begins;  // the local maps' analysis by rows (m * m + 1), its cells and shares
    const int32_t *parts;
    const double *shares;
    int64_t *counts;        // out: the numbers of each row, where `numbers` is null
    const int64_t *begin;   // where each row begins, where it is not
    void *columns;
    int16_t *numbers;
    int64_t frames, m, cells, terms;
    double scale;  // of a count, to units
    int32_t threshold, wide, threads;
};

struct RotatedLight {
    const float *source;    // (N, CHANNELS)
    const int64_t *starts;  // (rows + 1)
    const void *columns;    // int32 where wide, else int16
    const int16_t *numbers;
    float *out;
    int64_t rows;
    float unit;
    int32_t wide, threads;
};

// ptt/ops/slices.py

struct Reflected {
    const float *position, *normal, *dip, *frames, *eye, *weights, *light;
    const int32_t *near, *first;
    const int16_t *terms;
    const Half *values;
    float *out;                    // (points, CHANNELS)
    int64_t points, width, kept;   // width: cells of a local light; points and kept are multiples of GROUP
    int32_t distant, views, threads;
};

// ptt/ops/shade.py

struct Shade {
    const void *light, *dull, *glossy;  // of a Type; `dull` has 16 bits where light has fewer than 32
    const uint8_t *visibility;
    const float *light_scale, *glossy_scale;
    const int32_t *light_rows, *seen_rows, *view_rows, *region, *first;
    const float *light_weights, *seen_weights, *view_weights, *colour, *shares, *diffuse, *specular;
    const float *lamps;  // (points, 3), null where the light has them
    float *out;
    int64_t points, n, regions;
    int32_t lights, vertices, coats, type, threads;  // lights, vertices: rows that are mixed
};

// ptt/ops/near.py

struct NearFrames {
    const float *frames, *sampled;
    int32_t *rows;
    float *weights;
    int64_t points, n, twists;
    int32_t between, threads;
};

struct NearViews {
    const float *frames, *positions, *eye;  // positions: null where `eye` holds directions (points, 3)
    int32_t *rows;
    float *weights;
    int64_t points, views;
    int32_t threads;
};

struct NearTexels {
    const float *corner_uv;
    const int64_t *triangle;
    const float *barycentric;
    const int32_t *in_use;
    int32_t *rows;
    float *weights;
    int64_t points, side;
    int32_t threads;
};

// ptt/ops/triple.py

struct Adaptive {
    const int32_t *indices_f, *indices_g, *indices_h;
    const float *values_f, *values_g, *values_h;
    float *out;
    int64_t count_f, count_g, count_h, points, n;
    int32_t threads;
};
