"""G-buffer: the points that a camera sees, one for each pixel, for shading per pixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from ptt.imaging.image import Image
from ptt.light.environment import Environment
from ptt.ops import kinds
from ptt.scene.bumps import BumpMap
from ptt.scene.camera import Camera
from ptt.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class GBuffer:
    """The points that p pixels see, those that see a front face, row by row: traced once, shaded as often as one likes.

    camera: the camera that sees them
    pixel (p,): row * width + column
    triangle (p,), barycentric (p, 3): the place on the mesh
    positions (p, 3): interpolated, in world space
    frames (p, 3, 3): rows tangent, bitangent, normal; interpolated, orthonormal, bent by bump maps
    colours (p, 3): linear base colour, from the texture where there is one
    region (p,): index into `Scene.regions`
    uv (p, 2): texture coordinates; None where the scene has none
    missed (height * width,) bool: pixels that see nothing; those that see a back face are black
    glow (p, 3): radiance that the points send out by themselves; None where the scene has none
    """

    camera: Camera
    pixel: Tensor
    triangle: Tensor
    barycentric: Tensor
    positions: Tensor
    frames: Tensor
    colours: Tensor
    region: Tensor
    uv: Tensor | None
    missed: Tensor
    glow: Tensor | None = None

    @classmethod
    def of(cls, scene: Scene, camera: Camera, bumps: Mapping[str, BumpMap] | None = None) -> GBuffer:
        """Trace the rays through the pixels' centres.

        bumps: bump maps by region, in place of its own, which bend its frames; light and BRDFs follow them, visibility
            does not, as in the paper

        A frame whose tangent is parallel to its normal gets another tangent; a warning counts such frames.

        Raises:
            ValueError: a bump map has an unknown region, or the scene no uv; or scene and camera are of another
                kind.
        """
        kinds.check("scene", scene, Scene)
        kinds.check("camera", camera, Camera)
        eye, directions = camera.rays()
        hits = scene.surface.first_hit(eye.expand(camera.width * camera.height, 3), directions.reshape(-1, 3))
        pixel = hits.front.nonzero()[:, 0]
        triangle = hits.triangle[pixel]
        barycentric = hits.barycentric[pixel]

        def at_pixels(values: Tensor) -> Tensor:
            return scene.interpolated(values, triangle, barycentric)

        region = scene.face_region[triangle]
        return cls(
            camera=camera,
            pixel=pixel,
            triangle=triangle,
            barycentric=barycentric,
            positions=at_pixels(scene.vertices),
            frames=scene.bent_frames(triangle, barycentric, bumps),
            colours=scene.albedo(triangle, barycentric),
            region=region,
            uv=None if scene.uv is None else at_pixels(scene.uv),
            missed=hits.triangle < 0,
            glow=scene.glow(triangle, barycentric),
        )

    def interpolated(self, scene: Scene, values: Tensor) -> Tensor:
        """Values (p, ...) at the pixels, from those at the scene's vertices (v, ...)."""
        return scene.interpolated(values, self.triangle, self.barycentric)

    def image(self, radiance: Tensor, environment: Environment | None = None) -> Image:
        """The picture of radiance (p, 3), the environment behind it; black without one.

        Raises:
            ValueError: radiance is not finite (p, 3).
        """
        if radiance.shape != self.positions.shape or not bool(radiance.isfinite().all()):
            raise ValueError(f"radiance must be finite, {tuple(self.positions.shape)}, got {tuple(radiance.shape)}")
        pixels = radiance.new_zeros(len(self.missed), 3)
        if environment is not None:
            directions = self.camera.rays()[1].reshape(-1, 3)
            pixels[self.missed] = environment.radiance(directions[self.missed]).to(radiance)
        pixels[self.pixel] = radiance
        return Image(pixels.reshape(self.camera.height, self.camera.width, 3))
