"""Public names of this wing."""

from ._cohort import CohortResult as CohortResult
from ._cohort import fit_cohort as fit_cohort
from ._differences import Difference as Difference
from ._fit import fit as fit
from ._own_problem import Problem as Problem
from ._own_problem import problem as problem
from ._result import Estimate as Estimate
from ._result import FitResult as FitResult
from ._result import FittedPart as FittedPart
from ._result import load_result as load_result
from ._search import FitInterrupted as FitInterrupted
from ._study import StudyResult as StudyResult
from ._study import run_study as run_study
