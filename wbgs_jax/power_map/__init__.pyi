from ..data.floor_plan import load_walls as load_walls
from ..data.rssi_folder import cell_means as cell_means
from ..data.rssi_folder import load_readings as load_readings
from .model import learn_map as learn_map
from .model import received_power as received_power
