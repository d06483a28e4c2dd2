"""Pure functions on tensors: the mathematics of `ptt`. They know of no scene and no model.

One equation, per point v (Sun et al. 2007, equation 1):

    B(v, wo) = integral over the sphere of  L(wi) V(v, wi) f(wi, wo) max(wi . n, 0) dwi

The BRDF as a Tucker tensor (equation 2; `tucker`, on the disk grid of `sphere`, where the cosine is in the measure):

    f(h, wi, wo) ~ sum over h', o, i of  core[h', o, i] u_h[h, h'] u_o[o, wo] u_i[i, wi]

and, apart from it, lobes near the mirror direction (section 4.1; `separation`, `lobes`), G_k Gaussians of given widths
and integral 1:

    f(h, wi, wo) max(wi . n, 0) ~ tensor + sum over k of rho_k(h, wo) G_k(angle between wi and a_k(wo))

Direct transfer, per texel t of a cube map (`transfer`; rays by `raycast`), and in its Haar basis (`haar`):

    T0[v, i, t] = V[v, t] u_i[i, t] max(n . w_t, 0) dw_t           T0[v, i, l] = Haar of T0[v, i, t] over t
    sum over t of L[t] T0[v, i, t]  =  sum over l of L[l] T0[v, i, l],  since the basis is orthonormal

Transfer after one and two reflections (section 3.1; `ptt.transfer.bounces`), q a slot: a region and a function f_q by
which it reflects, Z_s harmonics that are orthonormal on the hemisphere with the cosine (`harmonics.hemispherical`), y
what v sees along w:

    T1[v, q, s, l]     = integral of  Z_s(w) (w . n)  sum over i of f_q[y, -w, i] T0[y, i, l]  dw
    T2[v, q', q, l]    = integral of  Z_0 (w . n)  sum over s of  f_q'[y, -w, s] T1[y, q, s, l]  dw
    I[v, s, c]         = sum over q, l of H[q, c] L[l, c] T1
                       + sum over q, q', l of H[q, c] H[q', c] L[l, c] T2  where s = 0

by clusters of points (section 4.3; `cpca`): T[v] ~ sum over e of w[v, e] T[e], e the eigen-points of v's cluster.

Relighting (equation 3; `relight`, `view`), in the order of what changes:

    U[c, i] = sum over l of L[l, c] T0[i, l]                                    light; T1 and T2 alike
    Q[c, o] = sum over i of M[c, o, i] (U[c, i] + sum over s of C[s, i] I[s, c])  BRDF: M is the core at a material's
                                                                                 coordinates, C Z_s seen by a factor
    B[v, c] = sum over o of V[o, v] Q[c, o, v]  +  lobes                        view: V is u_o in the view direction

or, in place of its tensor, by narrow lobes n of each material (`cells`, `gloss`), E irradiance, E_n light under a lobe,
V_n what v sees of it, y_n the point that it sees otherwise:

    B[v, c] = albedo[c] / pi E[v, c]  +  sum over n of w_n[c] (V_n[v] E_n[c] + (1 - V_n[v]) B[y_n, c])

Rotated light (Wang et al. 2006, equations 5 to 7; `rotation`, `slices`), n a sampled normal, W Haar transforms:

    R_n = W_M S_n W_N^T                                                         S_n: the map resampled around n
    B[v, c] = sum over k of w[k, v]  sum over j of  F[o(v, k), j]  sum over l of  R_k[j, l] L[l, c]

Triple products in local frames (Ma et al. 2006; `geodesic`, `triple`, `local`, `near`, `shade`), C_ijk by its theorem:

    B[p, c] = sum over i, j, k of  C_ijk L[p, c, i] V[p, j] F[p, c, k]          in the triangular Haar basis
            = 20 / n sum over t of  L[p, c, t] V[p, t] F[p, c, t]               on the n triangles of a level

Departures from Sun et al.: the cosine weights of each point are scaled so that its hemisphere sums to pi; coefficients
of T0 are shared out among the factors of a point by what each adds to the picture (`ptt.transfer.assembly`); lobes take
over all light that the smooth remainder lacks, and lean to where it comes from (`separation`); indirect light arrives
in harmonics of the hemisphere, not the sphere.

Example, the integral of a constant over the sphere, in wavelets:
    >>> import torch
    >>> from ptt.ops import haar, sphere
    >>> grid = sphere.Cube(8)
    >>> light, weight = haar.analyse(torch.ones(6, 8, 8).double()), haar.analyse(grid.solid_angles())
    >>> round(float((light * weight).sum() / torch.pi), 6)
    4.0
"""
