"""Public names of this wing."""

from ._cohort_text import cohort_card as cohort_card
from ._fit_text import fit_card as fit_card
from ._fit_text import fit_details as fit_details
from ._fit_text import fit_text as fit_text
from ._methods import fit_methods as fit_methods
from ._methods import study_methods as study_methods
from ._pages import REPORT as REPORT
from ._pages import cohort_report as cohort_report
from ._pages import fit_report as fit_report
from ._pages import posterior_report as posterior_report
from ._pages import study_report as study_report
from ._study_text import study_card as study_card
from ._study_text import study_notices as study_notices
