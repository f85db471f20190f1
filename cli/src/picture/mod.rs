//! Pictures as PNG files: scenes, maps, and curves.

mod canvas;
mod legend;
mod palette;
pub mod plot;
pub mod scene;
