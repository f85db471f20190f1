//! Multiple reflection between plane faces: geometrical optics along every sequence of faces, physical optics on its last.
//!
//! Each reflection mirrors the transmitter; what light of a sequence falls on its last face is a polygon, cut from the face by
//! the (mirrored) faces before it as seen from the last image. Every current sees each field of geometrical optics once: the
//! sequences 1-2 and 2-1 of a dihedral are two integrals, and nothing that physical optics has scattered is reflected again.
//! Nothing is sampled: the polygons are exact, and phase is that of the image.
//!
//! Faces do not hide each other but by facing away: corners, not rooms with furniture.

use glam::DVec3;
use num_complex::Complex64;

use super::Phasor3;
use super::boundary::Boundary;
use super::current::{Arrival, heard};
use super::facet::{Accuracy, Integral, Sample, integrate};
use super::link::{Link, transverse};
use super::terminal::Terminal;
use crate::geometry::{Surface, polygon};

/// A plane reflecting face.
#[derive(Debug, Clone, PartialEq)]
pub struct Face {
    /// Convex polygon, counter-clockwise seen from its front.
    pub corners: Vec<DVec3>,
    /// What it is made of.
    pub boundary: Boundary,
}

/// What one sequence of faces contributes.
#[derive(Debug, Clone, PartialEq)]
pub struct Contribution {
    /// Faces in the order in which the wave meets them.
    pub faces: Vec<usize>,
    /// Its integral over the last one.
    pub integral: Integral,
}

/// A wave on its way: where it seems to come from, and the windows that it has passed, in the same mirrored space.
struct Beam {
    faces: Vec<usize>,
    source: Terminal,
    windows: Vec<Vec<DVec3>>,
}

/// All sequences of up to `max_bounces` faces that light reaches.
pub fn contributions(faces: &[Face], link: &Link, accuracy: Accuracy, max_bounces: usize) -> Vec<Contribution> {
    let mut all = Vec::new();
    let start = Beam { faces: Vec::new(), source: link.tx, windows: Vec::new() };
    follow(faces, link, accuracy, max_bounces, &start, &mut all);
    all
}

fn follow(faces: &[Face], link: &Link, accuracy: Accuracy, left: usize, beam: &Beam, all: &mut Vec<Contribution>) {
    if left == 0 {
        return;
    }
    for (i, face) in faces.iter().enumerate() {
        let Some(&corner) = face.corners.first() else { continue };
        let normal = polygon::normal(&face.corners);
        if beam.faces.last() == Some(&i) || beam.source.side(corner, normal) <= 0.0 {
            continue;
        }
        let lit = beam
            .windows
            .iter()
            .fold(face.corners.clone(), |lit, window| polygon::through_window(lit, window, &beam.source));
        if lit.len() < 3 {
            continue;
        }
        let mut sequence = beam.faces.clone();
        sequence.push(i);
        let integral = last_bounce(faces, link, accuracy, &sequence, &beam.source, &lit);
        if integral.facets > 0 {
            all.push(Contribution { faces: sequence.clone(), integral });
        }
        let mirror = |p: DVec3| p - normal * (2.0 * normal.dot(p - corner));
        let mut windows: Vec<Vec<DVec3>> =
            beam.windows.iter().map(|w| w.iter().map(|&p| mirror(p)).collect()).collect();
        windows.push(face.corners.clone());
        let reflected = Beam { faces: sequence, source: beam.source.mirrored(corner, normal), windows };
        follow(faces, link, accuracy, left - 1, &reflected, all);
    }
}

/// Physical optics over what is lit of the last face of a sequence.
fn last_bounce(
    faces: &[Face],
    link: &Link,
    accuracy: Accuracy,
    sequence: &[usize],
    source: &Terminal,
    lit: &[DVec3],
) -> Integral {
    let chain: Vec<(DVec3, Boundary)> =
        sequence.iter().filter_map(|&i| faces.get(i)).map(|f| (polygon::normal(&f.corners), f.boundary)).collect();
    let Some((&(last_normal, last_boundary), before)) = chain.split_last() else { return Integral::default() };
    let k = accuracy.wavenumber_per_m;
    let surface = fan(lit, last_normal);
    integrate(&surface, accuracy, |point, normal| {
        let (there, back) = (source.leg(point), link.rx.leg(point));
        let lit = normal.dot(there.towards) > 0.0 && normal.dot(back.towards) > 0.0;
        if !lit {
            return Sample { length_m: there.length_m + back.length_m, amplitude: Complex64::ZERO, lit };
        }
        // The direction on departure: the last one, mirrored back along the chain.
        let arrival = -there.towards;
        let departure = before.iter().rev().fold(arrival, |d, (n, _)| d - *n * (2.0 * n.dot(d)));
        let polarisation = transverse(link.tx_polarisation, departure);
        let (field, direction) = before
            .iter()
            .fold((Phasor3::real(polarisation), departure), |(e, d), (n, boundary)| boundary.reflect(e, d, *n, k));
        let listener = link.listener(back.towards);
        let amplitude = heard(&Arrival { field, direction }, normal, &last_boundary, k, &listener);
        Sample {
            length_m: there.length_m + back.length_m,
            amplitude: amplitude * (there.spreading * back.spreading),
            lit,
        }
    })
}

/// A convex polygon as triangles.
fn fan(corners: &[DVec3], normal: DVec3) -> Surface {
    Surface {
        vertices: corners.to_vec(),
        normals: vec![normal; corners.len()],
        triangles: (2..corners.len() as u32).map(|i| [0, i - 1, i]).collect(),
        two_sided: false,
    }
}

/// The two square faces of a dihedral whose edge stands on the z axis, opening towards +x and +y.
pub fn dihedral(width_m: f64, height_m: f64, boundary: Boundary) -> Vec<Face> {
    let (low, high) = (-0.5 * height_m, 0.5 * height_m);
    let face = |along: DVec3| {
        vec![DVec3::Z * low, along * width_m + DVec3::Z * low, along * width_m + DVec3::Z * high, DVec3::Z * high]
    };
    // Counter-clockwise from the front: the face along x looks to +y, the one along y to +x.
    let mut along_x = face(DVec3::X);
    along_x.reverse();
    vec![Face { corners: along_x, boundary }, Face { corners: face(DVec3::Y), boundary }]
}

/// The faces of a trihedral with its corner at the origin and its edges on the positive axes: triangles or squares.
pub fn trihedral(edge_m: f64, square: bool, boundary: Boundary) -> Vec<Face> {
    let face = |u: DVec3, v: DVec3| {
        let mut corners = vec![DVec3::ZERO, u * edge_m];
        if square {
            corners.push((u + v) * edge_m);
        }
        corners.push(v * edge_m);
        Face { corners, boundary }
    };
    vec![face(DVec3::X, DVec3::Y), face(DVec3::Y, DVec3::Z), face(DVec3::Z, DVec3::X)]
}

#[cfg(test)]
mod hard_cases {
    use super::*;

    const K: f64 = 1_257.507_013_171_009;

    fn link(towards: DVec3) -> Link {
        Link::monostatic(Terminal::Far(towards), DVec3::Z)
    }

    /// Both orders carry the same, each lights all of its last face at 45 degrees, and nothing else has two bounces.
    #[test]
    fn a_dihedral_has_two_orders_counted_once_each() {
        let faces = dihedral(0.1, 0.1, Boundary::Conductor);
        let accuracy = Accuracy { wavenumber_per_m: K, tolerance_rad: 0.03 };
        let found = contributions(&faces, &link(DVec3::new(1.0, 1.0, 0.0).normalize()), accuracy, 4);
        let double: Vec<_> = found.iter().filter(|c| c.faces.len() == 2).collect();
        assert_eq!(double.len(), 2);
        for c in &double {
            // Area times cosine, no phase at all: the corner is the origin.
            assert!((c.integral.value.norm() - 0.01 * 0.5f64.sqrt()).abs() < 1e-12, "{:?}", c.integral);
        }
        assert!((double[0].integral.value - double[1].integral.value).norm() < 1e-12);
        assert!(found.iter().all(|c| c.faces.len() <= 2));
    }

    /// Six orders of three bounces, whose lit polygons together are the aperture of the closed form.
    #[test]
    fn a_trihedral_has_six_orders() {
        let accuracy = Accuracy { wavenumber_per_m: K, tolerance_rad: 0.03 };
        for (square, area) in [(false, 0.01 / 3f64.sqrt()), (true, 0.01 * 3f64.sqrt())] {
            let faces = trihedral(0.1, square, Boundary::Conductor);
            let found = contributions(&faces, &link(DVec3::ONE.normalize()), accuracy, 6);
            let triple: Vec<_> = found.iter().filter(|c| c.faces.len() == 3).collect();
            assert_eq!(triple.len(), 6);
            let sum: Complex64 = triple.iter().map(|c| c.integral.value).sum();
            assert!((sum.norm() / area - 1.0).abs() < 1e-9, "{sum} {area}");
        }
    }
}
