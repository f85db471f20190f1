//! Pictures as PNG and SVG files: scenes, maps, and curves.

mod canvas;
mod legend;
mod mark;
mod palette;
pub mod plot;
mod raster;
mod room;
pub mod scene;
mod svg;
pub mod theme;
mod trajectories;
mod view;
