"""Pure functions on tensors: the mathematics of `ptt`. They know of no scene and no model.

One equation, per point v (Sun et al. 2007, equation 1):

    B(v, wo) = integral over the sphere of  L(wi) V(v, wi) f(wi, wo) max(wi . n, 0) dwi

The BRDF as a Tucker tensor (equation 2; `tucker`, on the disk grid of `sphere`, where the cosine is in the measure):

    f(h, wi, wo) ~ sum over h', o, i of  core[h', o, i] u_h[h, h'] u_o[o, wo] u_i[i, wi]

and, apart from it, lobes around the mirror direction (section 4.1; `lobes`), G_k Gaussians of given widths:

    f(h, wi, wo) ~ tensor + sum over k of a_k(h, wo) G_k(angle between wi and the mirror image of wo)

Direct transfer, per texel t of a cube map (`transfer`; rays by `raycast`), and in its Haar basis (`haar`):

    T0[v, i, t] = V[v, t] u_i[i, t] max(n . w_t, 0) dw_t           T0[v, i, l] = Haar of T0[v, i, t] over t
    sum over t of L[t] T0[v, i, t]  =  sum over l of L[l] T0[v, i, l],  since the basis is orthonormal

Relighting (equation 3; `relight`), in the order of what changes:

    U[c, i, v] = sum over l of L[l, c] T0[v, i, l]          light
    Q[c, o, v] = sum over i of M[c, r(v), o, i] U[c, i, v]  BRDF: M is the core at a material's coordinates and weights
    B[v, c]    = sum over o of V[o, v] Q[c, o, v]           view: V is u_o in the point's view direction

Departures from the paper: the cosine weights of each point are scaled so that its hemisphere sums to pi; coefficients
of T0 are shared out among the factors of a point by what each adds to the picture (`ptt.compress`); lobes take over all
light that the smooth remainder lacks (`lobes`).

Example, the integral of a constant over the sphere, in wavelets:
    >>> import torch
    >>> from ptt.ops import haar, sphere
    >>> grid = sphere.Cube(8)
    >>> light, weight = haar.analyse(torch.ones(6, 8, 8).double()), haar.analyse(grid.solid_angles())
    >>> round(float((light * weight).sum() / torch.pi), 6)
    4.0
"""
