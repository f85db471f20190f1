//! Statistics of maps and of slow time: distributions of cells, noise floor, static and moving power, breathing.

mod maps;
mod noise;
mod slow_time;

pub use maps::{CellDistance, CellHistogram, MapDistance, MapStatistics, RaisedCells, Regions};
pub use noise::noise_floor_db;
pub use slow_time::{MotionLine, SlowTimeStatistics, StaticChanges};
