from .baselines.known_law import KnownLaw
from .baselines.nclaw import NCLaw, NeuMA, load_nclaw
from .baselines.sparse_law import SparseLaw
from .baselines.spring_gaus import SpringMass
from .baselines.stage_one_latents import MeanLatent, RandomLatent, UniPhy
from .fewshot.low_rank import LowRankAdaptation
from .fewshot.method import Method
from .inference.law_file import load_law, save_law
from .inference.outputs import write_particles, write_video
from .inference.prepared_scene import PreparedScene, prepare
from .inference.video_law import VideoLaw, read_law
from .operator.dynamics_operator import IntrinsicDynamicsOperator, Operator
from .operator.law_properties import Moduli, small_strain_moduli
from .reconstruct.filling import fill, opacity_volume, visual_hull
from .reconstruct.gaussian_fit import ReconstructModule
from .render.gaussians import attach_gaussians, bind, deform, load_gaussians, save_gaussians
from .render.splatting import Splatting, rasterize, render
from .scoring.losses import relative_lp
from .scoring.lpips import LPIPS
from .scoring.metrics import ChamferDistance, MatchedRMSE, MedianRelativeError, chamfer_distance
from .stages.adapt import AdaptModule
from .stages.align import AlignModule
from .stages.made_scenes import MadeSceneDataModule
from .stages.pretrain import PretrainModule
from .stages.pretrain_vae import FlowVAEModule
from .stages.warmup import WarmupModule
from .video.encoder import DynamicsEncoder, Encoder
from .video.flow_vae import FlowVAE
from .video.reader import Reading, Readings

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
    "MadeSceneDataModule",
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
    "Reading",
    "Readings",
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
