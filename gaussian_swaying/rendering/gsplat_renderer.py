"""Renderer on top of the CUDA rasterizer of gsplat."""

import importlib.util
import os
import sys
import threading
import warnings
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import ModuleType

import torch
from filelock import FileLock, Timeout
from torch import Tensor, _appdirs, nn

from gaussian_swaying._files import write_text
from gaussian_swaying.gaussians.harmonics import sh_degree
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.protocol import (
    BLUR,
    RenderOutput,
    ScreenGaussians,
    SplatOutput,
    SplatRenderer,
    check_gaussians,
    finite_gaussians,
)
from gaussian_swaying.rendering.torch_renderer import TorchRenderer


def gsplat_works() -> bool:
    """True if gsplat's CUDA kernels exist or can be compiled, which takes about a minute the first time."""
    if not torch.cuda.is_available():
        return False
    try:
        return load_kernels()
    except Exception:  # the compiler failed; its messages are on the terminal
        return False


@cache
def load_kernels() -> bool:
    """Load gsplat's CUDA kernels, or compile them at the first use on a machine.

    One process compiles at a time and the others wait: gsplat 1.5.3 deletes the folder of a build that is not finished,
    also if another process is at work there. What was compiled and loaded once is loaded by its file from then on, as
    long as gsplat, its sources, torch and the options are the same: gsplat would call the compilers again to ask for
    their versions. Later calls do nothing.

    Returns:
        Whether there are kernels: False if gsplat finds no compiler.
    """
    with _LOADING:
        library = build_folder() / "gsplat_cuda.so"
        stamp = library.with_suffix(".stamp")
        try:
            if stamp.read_text(encoding="utf-8") == _stamp(library):
                _load(library)
                return True
        except (ImportError, OSError, ValueError):  # it was never loaded, or is broken
            pass
        lock = FileLock(library.parent.with_suffix(".lock"))
        try:
            library.parent.mkdir(parents=True, exist_ok=True)
            lock.acquire(timeout=0)
        except Timeout:
            print("Another process is compiling the CUDA kernels of gsplat: waiting until it is done.", file=sys.stderr)
            lock.acquire()
        except OSError:  # a folder that cannot be written to: what lies there was compiled before
            pass
        try:
            from gsplat.cuda._backend import _C
        except ModuleNotFoundError:  # another version of gsplat, which keeps its kernels elsewhere
            return True
        finally:
            lock.release()
        if getattr(_C, "__file__", None) == str(library):  # and not kernels that gsplat came with
            with suppress(OSError):  # a folder that cannot be written to
                write_text(stamp, _stamp(library))
        return _C is not None


_LOADING = threading.Lock()


def loaded_before() -> bool:
    """True if :func:`load_kernels` will load cached kernels, which takes a moment."""
    folder = build_folder()
    try:
        return (folder / "gsplat_cuda.stamp").read_text(encoding="utf-8") == _stamp(folder / "gsplat_cuda.so")
    except (ImportError, OSError, ValueError):
        return False


def build_folder() -> Path:
    """Build folder of gsplat's kernels; torch's own function for it is slow to import."""
    root = os.environ.get("TORCH_EXTENSIONS_DIR")
    if root is None:
        python = f"py{sys.version_info.major}{sys.version_info.minor}{getattr(sys, 'abiflags', '')}"
        version = "cpu" if torch.version.cuda is None else f"cu{torch.version.cuda.replace('.', '')}"
        home = os.path.realpath(_appdirs.user_cache_dir(appname="torch_extensions"))
        root = os.path.join(home, f"{python}_{version}")
    return Path(root) / "gsplat_cuda"


def _stamp(library: Path) -> str:
    from importlib.metadata import version

    found = importlib.util.find_spec("gsplat")
    if found is None or found.origin is None:
        raise ImportError("no gsplat")
    sources = Path(found.origin).parent / "cuda"
    newest = max(file.stat().st_mtime_ns for folder in ("", "csrc", "include") for file in (sources / folder).glob("*"))
    devices = [torch.cuda.get_device_capability(device) for device in range(torch.cuda.device_count())]
    options, file = {name: os.environ.get(name) for name in _OPTIONS}, library.stat()
    made_of = version("gsplat"), str(sources), newest, torch.__version__, devices, options
    return repr((*made_of, file.st_size, file.st_mtime_ns))


_OPTIONS = ("TORCH_CUDA_ARCH_LIST", "NO_FAST_MATH", "FAST_COMPILE", "USE_PRECOMPILED_HEADERS", "CUDA_HOME", "CXX")


def _load(library: Path) -> None:
    spec = importlib.util.spec_from_file_location("gsplat_cuda", library)
    assert spec is not None
    assert spec.loader is not None
    kernels = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(kernels)
    backend = ModuleType("gsplat.cuda._backend")
    backend._C = kernels  # type: ignore[attr-defined]
    sys.modules[backend.__name__] = backend


def render_gsplat(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera: Camera,
    background: Tensor | None = None,
) -> RenderOutput:
    """Draw Gaussians as ``gsplat.rasterization`` (Ye et al. 2025, arXiv 2409.06765) does, in float32.

    It is built from gsplat's functions: ``rasterization`` makes the host wait several times, and this once. gsplat
    compiles its kernels at the first call, see :func:`load_kernels`.

    Args:
        means: Centres [scene units], on a CUDA device, shape (N, 3).

    Returns:
        The picture, in the precision of ``means``.
    """
    check_gaussians(means, covariances, opacities, colors, background)
    if not torch.cuda.is_available():
        raise RuntimeError("GsplatRenderer needs CUDA, but torch finds no CUDA device: use TorchRenderer instead.")
    if means.device.type != "cuda":
        raise RuntimeError(f"GsplatRenderer needs tensors on a CUDA device, but `means` is on {means.device}.")
    load_kernels()
    from gsplat import fully_fused_projection

    dtype = means.dtype
    if means.shape[0] == 0:
        pixels = means.new_zeros(camera.height, camera.width, 5)
        return _compose(pixels[..., :4], pixels[..., 4:], background, dtype)
    # gsplat skips opacities below 1/255, but would draw a mean or covariance that is not finite.
    finite = finite_gaussians(means, covariances, opacities, colors)
    opacities = torch.where(finite, opacities, 0.0).float()
    view, rows = camera.to(means.device, torch.float32), covariances.float()
    radii, means2d, depths, conics, _ = fully_fused_projection(
        means.float(),
        torch.cat([rows[:, 0], rows[:, 1, 1:], rows[:, 2, 2:]], dim=-1),  # the upper triangle
        None,
        None,
        view.world_to_camera[None],
        view.intrinsics[None],
        camera.width,
        camera.height,
        eps2d=BLUR,
        near_plane=camera.near,
        opacities=opacities,  # for a tighter radius
    )
    values = torch.cat([colors.float()[None], depths[..., None]], dim=-1)
    pixels, alpha = _rasterize(means2d, radii, depths, conics, values, opacities[None], camera)
    return _compose(pixels[0], alpha[0], background, dtype)


_TILE = 16  # pixels


def rasterize_splat(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    camera: Camera,
    background: Tensor | None = None,
    channels: Tensor | None = None,
) -> tuple[Tensor, Tensor, ScreenGaussians]:
    """``gsplat.rasterization`` for one camera, built from gsplat's functions.

    Picture and gradients are the same. ``rasterization`` inverts the camera's matrix to find the eye, and the host
    waits for that in the middle of a step. Here the camera provides its eye.

    Args:
        means: Centres [scene units], float32 on a CUDA device, shape (N, 3).
        scales: Standard deviations [scene units], shape (N, 3).
        sh: Coefficients of real spherical harmonics, shape (N, K, 3).
        channels: Further values to blend behind the colours, over zero, shape (N, E).

    Returns:
        Colours and further values (1, H, W, 3 + E), alphas (1, H, W, 1), and where the Gaussians are on the screen.
    """
    load_kernels()
    from gsplat import fully_fused_projection, spherical_harmonics

    radii, means2d, depths, conics, _ = fully_fused_projection(
        means,
        None,
        quats,
        scales,
        camera.world_to_camera[None],
        camera.intrinsics[None],
        camera.width,
        camera.height,
        eps2d=BLUR,
        near_plane=camera.near,
        packed=False,
        opacities=opacities,  # for a tighter radius
    )
    seen = (radii > 0).all(-1)
    colors = spherical_harmonics(sh_degree(sh.shape[-2]), (means - camera.position)[None], sh[None], masks=seen)
    values = (colors + 0.5).clamp_min(0.0)
    behind = None if background is None else background.to(means)[None]
    if channels is not None:
        values = torch.cat([values, channels[None]], dim=-1)
        behind = None if behind is None else torch.nn.functional.pad(behind, (0, channels.shape[-1]))
    pixels, alpha = _rasterize(means2d, radii, depths, conics, values, opacities[None], camera, behind)
    return pixels, alpha, ScreenGaussians(means2d, radii, None, camera.width, camera.height)


def _rasterize(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    conics: Tensor,
    values: Tensor,
    opacities: Tensor,
    camera: Camera,
    background: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Sort the Gaussians into tiles, for which the host waits, and blend values: (1, H, W, C) and (1, H, W, 1)."""
    from gsplat import isect_offset_encode, isect_tiles, rasterize_to_pixels

    tiles = (-(-camera.width // _TILE), -(-camera.height // _TILE))
    _, crossings, order = isect_tiles(means2d, radii, depths, _TILE, *tiles, packed=False, n_images=1)
    offsets = isect_offset_encode(crossings, 1, *tiles).reshape(1, tiles[1], tiles[0])
    size = (camera.width, camera.height, _TILE)
    blended: tuple[Tensor, Tensor] = rasterize_to_pixels(
        means2d, conics, values, opacities, *size, offsets, order, backgrounds=background
    )
    return blended


def _compose(pixels: Tensor, alpha: Tensor, background: Tensor | None, dtype: torch.dtype) -> RenderOutput:
    color, depth = pixels[..., :3], pixels[..., 3:].clone()
    if background is not None:
        color = torch.addcmul(color, 1.0 - alpha, background.to(color))
    return RenderOutput(color.to(dtype), alpha.to(dtype), depth.to(dtype))


class GsplatRenderer(nn.Module):
    """Renderer for CUDA devices, see :func:`render_gsplat`.

    Raises:
        RuntimeError: If there is no CUDA device.
    """

    def __init__(self) -> None:
        super().__init__()
        if not torch.cuda.is_available():
            raise RuntimeError("GsplatRenderer needs CUDA, but torch finds no CUDA device: use TorchRenderer instead.")

    def forward(
        self,
        means: Tensor,
        covariances: Tensor,
        opacities: Tensor,
        colors: Tensor,
        camera: Camera,
        background: Tensor | None = None,
    ) -> RenderOutput:
        """Render one picture, see :class:`~gaussian_swaying.rendering.protocol.Renderer`."""
        return render_gsplat(means, covariances, opacities, colors, camera, background)

    def render_splat(
        self,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        opacities: Tensor,
        sh: Tensor,
        camera: Camera,
        background: Tensor | None = None,
        channels: Tensor | None = None,
    ) -> SplatOutput:
        """Render one picture in training, see :class:`~gaussian_swaying.rendering.protocol.SplatRenderer`.

        Computed in float32. gsplat's kernels evaluate and differentiate harmonics and covariances. Gaussians that are
        not finite are not filtered out.
        """
        if means.device.type != "cuda":
            raise RuntimeError(f"GsplatRenderer needs tensors on a CUDA device, but `means` is on {means.device}.")
        view = camera.to(means.device, torch.float32)
        given = (means, quats, log_scales.exp(), opacities, sh, view, background, channels)
        pixels, alpha, screen = rasterize_splat(*given)
        if channels is None:
            return SplatOutput(pixels[0], alpha[0], screen)
        return SplatOutput(pixels[0, ..., :3], alpha[0], screen, pixels[0, ..., 3:])


def make_renderer(device: torch.device | str, detail: float = 0.0) -> SplatRenderer:
    """Return the renderer for a device: gsplat with CUDA, the torch renderer otherwise.

    If gsplat cannot compile its kernels (no ``nvcc``), the torch renderer draws on the GPU, with a warning.
    """
    if torch.device(device).type != "cuda" or not torch.cuda.is_available():
        return TorchRenderer(detail=detail)
    if gsplat_works():
        return GsplatRenderer()
    warnings.warn(
        "gsplat cannot compile its CUDA kernels here (it needs nvcc of torch's CUDA version): drawing with the slower "
        "torch renderer instead.",
        stacklevel=2,
    )
    return TorchRenderer(detail=detail)
