"""The settings of Gauss-Newton on surfels that the scan match and the graph share."""

from service.kernels.filter_state import STUDENT
from service.kernels.match import MatchSettings
from service.kernels.surfels import MIN_NORMAL_COSINE
from service.mapper.saved_graph import USUAL_RANGE_SIGMA_M

ALIGNMENT = MatchSettings(
    range_sigma_m=USUAL_RANGE_SIGMA_M,
    surfel_sigma_m=USUAL_RANGE_SIGMA_M,
    wall_sigma_m=0.006,
    repeats=1.0,
    chance_chi2=0.0,
    information_chance_chi2=0.0,
    cauchy_m=0.10,
    least_normal_cosine=MIN_NORMAL_COSINE,
    iterations=15,
    inlier_m=0.10,  # largest distance of an inlier from its surfel
    settled_m=0.0005,  # a smaller step ends the alignment
    settled_rad=0.0001,
    degrees_of_freedom=STUDENT,
)
