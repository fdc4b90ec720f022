"""The public names of shaker and where each lives, for type checkers and for `shaker/__init__.py`."""

from .compensation.effects import filtered_noise as filtered_noise
from .compensation.filter import Compensation as Compensation
from .compensation.filter import CompensationFilter as CompensationFilter
from .decoupling.common_pole_fit import fit_steps as fit_steps
from .decoupling.filter import design_decoupling as design_decoupling
from .decoupling.response_fit import fit_responses as fit_responses
from .elastomer.frame import solve_frame as solve_frame
from .frf.chain import ChainResponse as ChainResponse
from .frf.impact import transfer_impact as transfer_impact
from .frf.periodic import transfer_periodic as transfer_periodic
from .frf.random import transfer_random as transfer_random
from .frf.result import TransferRecord as TransferRecord
from .frf.sweeps import transfer_from_rest as transfer_from_rest
from .identification.measured_curves import MeasuredCurve as MeasuredCurve
from .identification.oscillator import fit_resonance as fit_resonance
from .identification.sensor import Load as Load
from .identification.sensor import correct_phasors as correct_phasors
from .identification.sensor import correct_record as correct_record
from .io import read_channels as read_channels
from .io.channel import RawChannel as RawChannel
from .io.universal import read_universal_functions as read_universal_functions
from .io.universal import read_universal_shapes as read_universal_shapes
from .lines.detection import survey_lines as survey_lines
from .lines.rate_planner import Sampling as Sampling
from .lines.rate_planner import lines_of as lines_of
from .lines.rate_planner import plan_at as plan_at
from .lti.indices import indices as indices
from .lti.system import LinearSystem as LinearSystem
from .mechanics import MassChain as MassChain
from .release.load_series import identify_loads as identify_loads
from .release.reading import read_release as read_release
from .release.record import StepRecord as StepRecord
from .release.record_file import read_step_record as read_step_record
from .release.step_fit import fit_step as fit_step
from .sine.phasor import Phasors as Phasors
from .sine.sine_fit import fit_sines as fit_sines
from .sine.solve import SineModel as SineModel
from .static_rotation.masses import fit_weights as fit_weights
from .timebase.edges import find_edges as find_edges
from .timebase.tie import tie_clocks as tie_clocks
from .timebase.trigger import fit_trigger as fit_trigger

__version__: str
