//! Warnings about materials outside their frequency bands. The test is a separate process, because a thread's
//! subscriber affects the others of its process.

mod common;

use std::sync::atomic::{AtomicUsize, Ordering};

/// Subscriber that counts warnings.
struct Warnings(AtomicUsize);

impl tracing::Subscriber for &'static Warnings {
    fn enabled(&self, metadata: &tracing::Metadata<'_>) -> bool {
        *metadata.level() == tracing::Level::WARN
    }
    fn new_span(&self, _: &tracing::span::Attributes<'_>) -> tracing::span::Id {
        tracing::span::Id::from_u64(1)
    }
    fn record(&self, _: &tracing::span::Id, _: &tracing::span::Record<'_>) {}
    fn record_follows_from(&self, _: &tracing::span::Id, _: &tracing::span::Id) {}
    fn event(&self, _: &tracing::Event<'_>) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
    fn enter(&self, _: &tracing::span::Id) {}
    fn exit(&self, _: &tracing::span::Id) {}
}

#[test]
fn a_material_outside_its_band_gives_one_warning() {
    static WARNINGS: Warnings = Warnings(AtomicUsize::new(0));
    tracing::subscriber::set_global_default(&WARNINGS).expect("the only one");
    let warning_count = |text: &str| {
        common::parse(text);
        WARNINGS.0.swap(0, Ordering::Relaxed)
    };
    let screed = "[materials.screed]\npermittivity = [4.0, 0.1]\nband_ghz = [50, 70]\n";
    let people = "[[people.actor]]\nstep = [{ walk_to_m = [2.0, 2.0] }]\n";
    let with_material = |text: &str, surface: &str, material: &str| {
        let surface_key = |material: &str| format!("{surface} = {{ material = \"{material}\"");
        text.replace(&surface_key("open"), &surface_key(material))
    };
    let hall = with_material(&common::hall(&format!("{people}{screed}")), "floor", "screed");
    let scene = with_material(&hall, "ceiling", "concrete").replace("\"open\"", "\"plasterboard\"");
    assert_eq!(warning_count(&scene), 0);
    assert_eq!(warning_count(&scene.replace("[50, 70]", "[1, 10]")), 1, "the floor");
    // The table's brick ends at 40 GHz. A material gives one warning, and not one for each of four walls.
    assert_eq!(warning_count(&scene.replace("plasterboard", "brick")), 1, "walls");
    // Furniture gives a warning too, and so do objects within a floor plan.
    let cupboard = "[[furniture]]\nname = \"cupboard\"\nposition_m = [4.0, 4.0, 0.0]\nsize_m = [1.0, 1.0, 1.0]\n";
    assert_eq!(warning_count(&format!("{scene}{cupboard}material = \"plywood\"\n")), 1, "a cupboard");
    let (before, rest) = scene.split_once("size_m").expect("written");
    let (_, after) = rest.split_once("[radar]").expect("written");
    let partition = |from_m: f64| {
        format!("[[room.plan.partition]]\nfrom_m = [{from_m:?}, 5.0]\nto_m = [{from_m:?}, 7.0]\nmaterial = \"felt\"\n")
    };
    let plan = format!(
        "{before}floor = {{ material = \"concrete\" }}\nceiling = {{ material = \"concrete\" }}\n[room.plan]\n\
         corners_m = [[0.0, 0.0], [20.0, 0.0], [20.0, 20.0], [0.0, 20.0]]\nheight_m = 3.0\n\
         walls = {{ material = \"plasterboard\" }}\n{}{}[radar]{after}\n\
         [materials.felt]\npermittivity = [1.5, 0.05]\nband_ghz = [1, 10]\n",
        partition(8.0),
        partition(9.0)
    );
    assert_eq!(warning_count(&plan), 1, "two partitions");
}
