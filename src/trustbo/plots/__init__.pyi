from .curves import robot_effects as robot_effects
from .curves import trust_curves as trust_curves
from .explorer import explore as explore
from .maps import cell_map as cell_map
from .maps import grid_map as grid_map
from .maps import terrain_maps as terrain_maps
from .maps import trust_maps as trust_maps
from .plan import plan_map as plan_map
