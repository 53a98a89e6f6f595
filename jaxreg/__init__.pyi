# ruff: noqa: I001 (by topic, not by the alphabet)
# The public names, by topic; `__init__.py` reads them here, and so do type checkers.

__version__: str

# Transforms and pairs of clouds
from .geometry.rigid import (
    apply as apply,
    compose as compose,
    from_jaxlie as from_jaxlie,
    from_matrix as from_matrix,
    identity as identity,
    inverse as inverse,
    to_jaxlie as to_jaxlie,
    to_matrix as to_matrix,
)
from .types import Pair as Pair, PointCloud as PointCloud, RigidTransform as RigidTransform

# Geometry
from .geometry.neighbors import knn as knn, nearest_neighbor as nearest_neighbor
from .geometry.normals import normals as normals
from .geometry.numerics import included_angle as included_angle
from .geometry.procrustes import (
    robust_procrustes as robust_procrustes,
    weighted_procrustes as weighted_procrustes,
)

# Registration from a start
from .refine.config import RefineConfig as RefineConfig
from .refine.gicp import gicp as gicp
from .refine.point_to_plane import point_to_plane as point_to_plane
from .refine.point_to_point import icp as icp
from .refine.uncertainty import (
    PoseUncertainty as PoseUncertainty,
    WeakDirection as WeakDirection,
    pose_uncertainty as pose_uncertainty,
    weak_directions as weak_directions,
)
from .types import Refinement as Refinement

# Pose graphs
from .graph.optimize import OptimizedPoses as OptimizedPoses, optimize_poses as optimize_poses
from .graph.pose_graph import PoseGraph as PoseGraph
from .graph.sparse import SolvedPoses as SolvedPoses, solve_poses as solve_poses

# Registration without a start
from .search.config import SearchConfig as SearchConfig
from .search.learned import load_features as load_features
from .search.pipeline import register_global as register_global, search_poses as search_poses
from .types import GlobalRegistration as GlobalRegistration

# The paper's network
from .config import LossConfig as LossConfig, ModelConfig as ModelConfig
from .network.batch import register_batch as register_batch
from .network.model import init_variables as init_variables, register_pair as register_pair
from .peers.rienet import load_rienet as load_rienet
from .types import Registration as Registration
from .weights.checkpoint import load_checkpoint as load_checkpoint
from .weights.released import (
    available_weights as available_weights,
    load_pretrained as load_pretrained,
)

# Programs in files
from .exported import (
    ExportedProgram as ExportedProgram,
    export_program as export_program,
    load_exported as load_exported,
)

# Other learned methods
from .config import (
    CEMNetConfig as CEMNetConfig,
    DCPConfig as DCPConfig,
    FMRConfig as FMRConfig,
    IDAMConfig as IDAMConfig,
    RPMNetConfig as RPMNetConfig,
)
from . import peers as peers

# Scans, on the host
from .io import read_cloud as read_cloud, write_cloud as write_cloud
from .scans.config import RegisterConfig as RegisterConfig
from .scans.pair import register as register
from .scans.prepare import Prepared as Prepared, prepare as prepare
from .scans.result import (
    Alternative as Alternative,
    FewEvidence as FewEvidence,
    ScanRegistration as ScanRegistration,
)
from .scans.many import Alignment as Alignment, register_many as register_many
from .view.page import write_page as write_page, write_registration_page as write_registration_page
from .view.pictures import plot_pair as plot_pair

# Data, training, evaluation
from .config import (
    Config as Config,
    DataConfig as DataConfig,
    PairConfig as PairConfig,
    TrainConfig as TrainConfig,
    load_config as load_config,
)
from .data.pairs import make_pair as make_pair
from .data.procedural.shapes import sample_shape as sample_shape
from .training import batch_loss as batch_loss, train as train

# Many pairs
from .batching import map_pairs as map_pairs
