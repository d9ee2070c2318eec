"""Models: the operator, laws from video, renderer, reconstruction, training stages, baselines and metrics.

The names of `__all__` are imported when they are first used, so that importing the package loads no torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neuido.models.baselines.known_law import KnownLaw as KnownLaw
    from neuido.models.baselines.nclaw import NCLaw as NCLaw
    from neuido.models.baselines.nclaw import NeuMA as NeuMA
    from neuido.models.baselines.nclaw import load_nclaw as load_nclaw
    from neuido.models.baselines.sparse_law import SparseLaw as SparseLaw
    from neuido.models.baselines.spring_gaus import SpringMass as SpringMass
    from neuido.models.baselines.stage_one_latents import MeanLatent as MeanLatent
    from neuido.models.baselines.stage_one_latents import RandomLatent as RandomLatent
    from neuido.models.baselines.stage_one_latents import UniPhy as UniPhy
    from neuido.models.fewshot.low_rank import LowRankAdaptation as LowRankAdaptation
    from neuido.models.fewshot.method import Method as Method
    from neuido.models.inference.law_file import load_law as load_law
    from neuido.models.inference.law_file import save_law as save_law
    from neuido.models.inference.outputs import write_plys as write_particles
    from neuido.models.inference.outputs import write_video as write_video
    from neuido.models.inference.prepared_scene import PreparedScene as PreparedScene
    from neuido.models.inference.prepared_scene import prepare as prepare
    from neuido.models.inference.video_law import VideoLaw as VideoLaw
    from neuido.models.inference.video_law import read_law as read_law
    from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator as IntrinsicDynamicsOperator
    from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator as Operator
    from neuido.models.operator.law_properties import Moduli as Moduli
    from neuido.models.operator.law_properties import small_strain_moduli as small_strain_moduli
    from neuido.models.reconstruct.filling import fill as fill
    from neuido.models.reconstruct.filling import opacity_volume as opacity_volume
    from neuido.models.reconstruct.filling import visual_hull as visual_hull
    from neuido.models.reconstruct.gaussian_fit import ReconstructModule as ReconstructModule
    from neuido.models.render.gaussians import attach_gaussians as attach_gaussians
    from neuido.models.render.gaussians import bind as bind
    from neuido.models.render.gaussians import deform as deform
    from neuido.models.render.gaussians import load_ply as load_gaussians
    from neuido.models.render.gaussians import save_ply as save_gaussians
    from neuido.models.render.splatting import Splatting as Splatting
    from neuido.models.render.splatting import rasterize as rasterize
    from neuido.models.render.splatting import render as render
    from neuido.models.scoring.losses import relative_lp as relative_lp
    from neuido.models.scoring.lpips import LPIPS as LPIPS
    from neuido.models.scoring.metrics import ChamferDistance as ChamferDistance
    from neuido.models.scoring.metrics import MatchedRMSE as MatchedRMSE
    from neuido.models.scoring.metrics import MedianRelativeError as MedianRelativeError
    from neuido.models.scoring.metrics import chamfer_distance as chamfer_distance
    from neuido.models.stages.adapt import AdaptModule as AdaptModule
    from neuido.models.stages.align import AlignModule as AlignModule
    from neuido.models.stages.pretrain import PretrainModule as PretrainModule
    from neuido.models.stages.pretrain_vae import FlowVAEModule as FlowVAEModule
    from neuido.models.stages.warmup import WarmupModule as WarmupModule
    from neuido.models.video.encoder import DynamicsEncoder as DynamicsEncoder
    from neuido.models.video.encoder import DynamicsEncoder as Encoder
    from neuido.models.video.flow_vae import FlowVAE as FlowVAE

__all__ = [
    "LPIPS",
    "AdaptModule",
    "AlignModule",
    "ChamferDistance",
    "DynamicsEncoder",
    "Encoder",
    "FlowVAE",
    "FlowVAEModule",
    "IntrinsicDynamicsOperator",
    "KnownLaw",
    "LowRankAdaptation",
    "MatchedRMSE",
    "MeanLatent",
    "MedianRelativeError",
    "Method",
    "Moduli",
    "NCLaw",
    "NeuMA",
    "Operator",
    "PreparedScene",
    "PretrainModule",
    "RandomLatent",
    "ReconstructModule",
    "SparseLaw",
    "Splatting",
    "SpringMass",
    "UniPhy",
    "VideoLaw",
    "WarmupModule",
    "attach_gaussians",
    "bind",
    "chamfer_distance",
    "deform",
    "fill",
    "load_gaussians",
    "load_law",
    "load_nclaw",
    "opacity_volume",
    "prepare",
    "rasterize",
    "read_law",
    "relative_lp",
    "render",
    "save_gaussians",
    "save_law",
    "small_strain_moduli",
    "visual_hull",
    "write_particles",
    "write_video",
]

_PLACES = {
    "AdaptModule": "stages.adapt",
    "AlignModule": "stages.align",
    "ChamferDistance": "scoring.metrics",
    "DynamicsEncoder": "video.encoder",
    "Encoder": "video.encoder:DynamicsEncoder",
    "FlowVAE": "video.flow_vae",
    "FlowVAEModule": "stages.pretrain_vae",
    "IntrinsicDynamicsOperator": "operator.dynamics_operator",
    "KnownLaw": "baselines.known_law",
    "LPIPS": "scoring.lpips",
    "LowRankAdaptation": "fewshot.low_rank",
    "MatchedRMSE": "scoring.metrics",
    "MeanLatent": "baselines.stage_one_latents",
    "MedianRelativeError": "scoring.metrics",
    "Method": "fewshot.method",
    "Moduli": "operator.law_properties",
    "NCLaw": "baselines.nclaw",
    "NeuMA": "baselines.nclaw",
    "Operator": "operator.dynamics_operator:IntrinsicDynamicsOperator",
    "PreparedScene": "inference.prepared_scene",
    "PretrainModule": "stages.pretrain",
    "RandomLatent": "baselines.stage_one_latents",
    "ReconstructModule": "reconstruct.gaussian_fit",
    "SparseLaw": "baselines.sparse_law",
    "Splatting": "render.splatting",
    "SpringMass": "baselines.spring_gaus",
    "UniPhy": "baselines.stage_one_latents",
    "VideoLaw": "inference.video_law",
    "WarmupModule": "stages.warmup",
    "attach_gaussians": "render.gaussians",
    "bind": "render.gaussians",
    "chamfer_distance": "scoring.metrics",
    "deform": "render.gaussians",
    "fill": "reconstruct.filling",
    "load_gaussians": "render.gaussians:load_ply",
    "load_law": "inference.law_file",
    "load_nclaw": "baselines.nclaw",
    "opacity_volume": "reconstruct.filling",
    "prepare": "inference.prepared_scene",
    "rasterize": "render.splatting",
    "read_law": "inference.video_law",
    "relative_lp": "scoring.losses",
    "render": "render.splatting",
    "save_gaussians": "render.gaussians:save_ply",
    "save_law": "inference.law_file",
    "small_strain_moduli": "operator.law_properties",
    "visual_hull": "reconstruct.filling",
    "write_particles": "inference.outputs:write_plys",
    "write_video": "inference.outputs",
}
"""The module of each public name below this package; after a colon its name there, where it is another one."""


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    place, _, own = _PLACES[name].partition(":")
    value = globals()[name] = getattr(import_module(f"{__name__}.{place}"), own or name)
    return value


def __dir__() -> list[str]:
    """List the public names beside the module's own."""
    return sorted({*globals(), *__all__})
