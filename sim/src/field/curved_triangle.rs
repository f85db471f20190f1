//! One curved triangle of a skin between two antennas: physical optics over all of it as the strength of one path.
//!
//! The triangle bulges between its corners as their normals say (a quadratic patch: edges are common with the neighbours', so
//! that the surface has no gaps). It is cut evenly into `4 m^2` flat ones, the path to their corners is exact, their integrals
//! are those of [`super::triangle`], and what the path still bends inside each is added as its mean. `m` is chosen so that the
//! middle of an edge misses the mean of its ends by no more than a tolerance, less where the phase runs fast along the edge:
//! there neighbours cancel and bending does not matter ([`super::facet`] cuts by the same rule, edge by edge).
//!
//! All lengths are differences from the path by the triangle's middle, in a form without cancellation, which is why single
//! precision does: [`Integrator::moments`] is held to [`exact_moments`] by test.

use glam::{DVec3, Vec3};
use num_complex::{Complex, Complex64};
use radome_dsp::KernelLevel;

use super::triangle;

/// Cuts of an edge in two, at most.
pub const MOST_CUTS: usize = 6;
/// Triangles side by side: as many as are best asked for at a time.
pub const LANES: usize = 16;
/// Phase difference along an edge beyond which bending matters less, by the square of the ratio, rad.
const STATIONARY_RAD: f64 = 10.0;
/// Nodes of a triangle whose edges are cut [`MOST_CUTS`] times in two.
const MOST_NODES: usize = (2 * MOST_CUTS + 1) * (2 * MOST_CUTS + 2) / 2;

type Row = [f32; LANES];

/// A quadratic patch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CurvedTriangle {
    /// Mean of the corners, m.
    pub middle: DVec3,
    /// Corners from there, m.
    pub corners: [Vec3; 3],
    /// How far the surface lies beside the middles of the edges (first to second corner, second to third, third to first), m.
    pub bulges: [Vec3; 3],
    /// Half of the squared differences of unit normals along the edges: by these, times both weights, the strength between
    /// corners is above the linear one, since normals in between are as long as they.
    pub turns: [f32; 3],
}

/// An antenna as the middle of a triangle sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    /// From the antenna to the middle, m.
    pub offset: DVec3,
    /// Length of that, m.
    pub distance_m: f64,
}

impl View {
    /// Of a point.
    pub fn new(antenna: DVec3, point: DVec3) -> Self {
        let offset = point - antenna;
        View { offset, distance_m: offset.length().max(1e-6) }
    }

    /// Unit vector from the middle to the antenna.
    pub fn towards(&self) -> DVec3 {
        -self.offset / self.distance_m
    }
}

impl CurvedTriangle {
    /// From corners, unit normals there and bulges, in the room.
    pub fn new(corners: [DVec3; 3], normals: [DVec3; 3], bulges: [DVec3; 3]) -> Self {
        let middle = (corners[0] + corners[1] + corners[2]) / 3.0;
        CurvedTriangle {
            middle,
            corners: corners.map(|c| (c - middle).as_vec3()),
            bulges: bulges.map(|b| b.as_vec3()),
            turns: [0, 1, 2].map(|i| 0.5 * normals[i].distance_squared(normals[(i + 1) % 3]) as f32),
        }
    }

    /// A place by its weights of the corners, from the middle, m.
    #[inline(always)]
    fn place(&self, [a, b, c]: [f32; 3]) -> Vec3 {
        let flat = self.corners[0] * a + self.corners[1] * b + self.corners[2] * c;
        let [ab, bc, ca] = self.bulges;
        flat + 4.0 * (ab * (a * b) + bc * (b * c) + ca * (c * a))
    }

    /// Into how many parts edges are to be cut, in two each, so that no more than a tolerance of bending is left.
    pub fn cuts(&self, tx: &View, rx: &View, wavenumber_per_m: f64, tolerance_rad: f64) -> usize {
        let longer = |weights: [f32; 3]| {
            let place = self.place(weights).as_dvec3();
            longer_m(tx, place) + longer_m(rx, place)
        };
        let ends = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(longer);
        let middles = [[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]].map(longer);
        let mut most: f64 = 0.0;
        for i in 0..3 {
            let (from, to) = (ends[i], ends[(i + 1) % 3]);
            let bend = wavenumber_per_m * (middles[i] - 0.5 * (from + to));
            let along = wavenumber_per_m * (to - from) / STATIONARY_RAD;
            most = most.max(bend.abs() / (1.0 + along * along));
        }
        ((most / tolerance_rad).sqrt().ceil() as usize).clamp(1, MOST_CUTS)
    }
}

/// How much longer the way is to a place beside the middle, m: `(|d|^2 + 2 d.e)/(|e + d| + |e|)`.
fn longer_m(view: &View, place: DVec3) -> f64 {
    let more = place.length_squared() + 2.0 * place.dot(view.offset);
    more / (view.distance_m + (view.distance_m * view.distance_m + more).max(0.0).sqrt())
}

/// Where an even cut has its nodes, and which of them make triangles.
struct Cut {
    /// Weights of the corners.
    nodes: Vec<[f32; 3]>,
    parts: Vec<Part>,
}

/// A part that is cut in four: its corners, then the middles of its edges.
struct Part {
    six: [usize; 6],
}

/// Corners of the four triangles of a part, by their places in [`Part::six`].
const QUARTERS: [[usize; 3]; 4] = [[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]];

impl Cut {
    fn new(cuts: usize) -> Self {
        let n = 2 * cuts;
        let index = |i: usize, j: usize| i * (n + 1) - i * i.saturating_sub(1) / 2 + j;
        let mut nodes = vec![[0.0; 3]; (n + 1) * (n + 2) / 2];
        for i in 0..=n {
            for j in 0..=n - i {
                nodes[index(i, j)] = [(n - i - j) as f32, j as f32, i as f32].map(|w| w / n as f32);
            }
        }
        let mut parts = Vec::new();
        let mut part = |a: [usize; 2], b: [usize; 2], c: [usize; 2]| {
            let middle = |p: [usize; 2], q: [usize; 2]| [(p[0] + q[0]) / 2, (p[1] + q[1]) / 2];
            let six = [a, b, c, middle(a, b), middle(b, c), middle(c, a)].map(|[i, j]| index(i, j));
            parts.push(Part { six });
        };
        for i in (0..n).step_by(2) {
            for j in (0..n - i).step_by(2) {
                part([i, j], [i, j + 2], [i + 2, j]);
                if i + j + 4 <= n {
                    part([i + 2, j + 2], [i + 2, j], [i, j + 2]);
                }
            }
        }
        Cut { nodes, parts }
    }
}

/// Physical optics over curved triangles, for one number of instructions' width.
pub struct Integrator {
    cuts: Vec<Cut>,
    level: KernelLevel,
}

impl std::fmt::Debug for Integrator {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Integrator").field("level", &self.level).finish_non_exhaustive()
    }
}

impl Default for Integrator {
    fn default() -> Self {
        Integrator { cuts: (1..=MOST_CUTS).map(Cut::new).collect(), level: KernelLevel::detect() }
    }
}

/// `int l_i exp(-j k (L - L_middle)) dS` over a triangle for the weights `l_i` of its three corners, m^2: what a strength
/// linear between the corners integrates to is their sum weighted by it.
pub type Moments = [Complex<f32>; 3];

impl Integrator {
    /// The instructions that it uses.
    pub fn level(&self) -> KernelLevel {
        self.level
    }

    /// Moments of triangles that are all cut alike, each between its own views of transmitter and receiver.
    pub fn moments(
        &self,
        triangles: &[(CurvedTriangle, View, View)],
        wavenumber_per_m: f64,
        cuts: usize,
        out: &mut Vec<Moments>,
    ) {
        let Some(cut) = self.cuts.get(cuts.clamp(1, MOST_CUTS) - 1) else { return };
        for some in triangles.chunks(LANES) {
            let moments = match self.level {
                KernelLevel::Portable => body(cut, some, wavenumber_per_m),
                // SAFETY: `level` is only ever one that the processor has.
                #[cfg(target_arch = "x86_64")]
                KernelLevel::Avx2 => unsafe { body_avx2(cut, some, wavenumber_per_m) },
                // SAFETY: as above.
                #[cfg(target_arch = "x86_64")]
                KernelLevel::Avx512 => unsafe { body_avx512(cut, some, wavenumber_per_m) },
                #[cfg(not(target_arch = "x86_64"))]
                KernelLevel::Avx2 | KernelLevel::Avx512 => body(cut, some, wavenumber_per_m),
            };
            out.extend(moments.iter().take(some.len()));
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn body_avx2(cut: &Cut, triangles: &[(CurvedTriangle, View, View)], k: f64) -> [Moments; LANES] {
    body(cut, triangles, k)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,avx512f,avx512bw,avx512dq,avx512vl")]
fn body_avx512(cut: &Cut, triangles: &[(CurvedTriangle, View, View)], k: f64) -> [Moments; LANES] {
    body(cut, triangles, k)
}

/// Every step in as many triangles as there are lanes.
#[inline(always)]
fn body(cut: &Cut, triangles: &[(CurvedTriangle, View, View)], k: f64) -> [Moments; LANES] {
    let zero: Row = [0.0; LANES];
    let (mut corners, mut bulges, mut turns) = ([[zero; 3]; 3], [[zero; 3]; 3], [zero; 3]);
    let (mut offsets, mut distances) = ([[zero; 3]; 2], [[1.0; LANES]; 2]);
    for (lane, (triangle, tx, rx)) in triangles.iter().take(LANES).enumerate() {
        for i in 0..3 {
            turns[i][lane] = triangle.turns[i];
            for axis in 0..3 {
                corners[i][axis][lane] = triangle.corners[i][axis];
                bulges[i][axis][lane] = 4.0 * triangle.bulges[i][axis];
            }
        }
        for (i, view) in [tx, rx].into_iter().enumerate() {
            for (to, from) in offsets[i].iter_mut().zip(view.offset.to_array()) {
                to[lane] = from as f32;
            }
            distances[i][lane] = view.distance_m as f32;
        }
    }
    let k = k as f32;
    let mut place = [[zero; 3]; MOST_NODES];
    let mut phase = [zero; MOST_NODES];
    for ((place, phase), &[a, b, c]) in place.iter_mut().zip(&mut phase).zip(&cut.nodes) {
        let (ab, bc, ca) = (a * b, b * c, c * a);
        for axis in 0..3 {
            for l in 0..LANES {
                let flat = corners[0][axis][l] * a + corners[1][axis][l] * b + corners[2][axis][l] * c;
                let bulge = bulges[0][axis][l] * ab + bulges[1][axis][l] * bc + bulges[2][axis][l] * ca;
                place[axis][l] = flat + bulge;
            }
        }
        for l in 0..LANES {
            let (x, y, z) = (place[0][l], place[1][l], place[2][l]);
            let square = x * x + y * y + z * z;
            let mut longer = 0.0;
            for (offset, distance) in offsets.iter().zip(&distances) {
                let more = square + 2.0 * (x * offset[0][l] + y * offset[1][l] + z * offset[2][l]);
                longer += more / (distance[l] + (distance[l] * distance[l] + more).max(0.0).sqrt());
            }
            phase[l] = -k * longer;
        }
    }
    let (mut re, mut im) = ([zero; 3], [zero; 3]);
    for part in &cut.parts {
        let mut shift = zero;
        let six = part.six.map(|node| &phase[node]);
        for l in 0..LANES {
            // What is left of the path over the linear one in each quarter has its mean at a twelfth of what the middles miss.
            shift[l] = ((six[3][l] + six[4][l] + six[5][l]) - (six[0][l] + six[1][l] + six[2][l])) / 12.0;
        }
        for quarter in &QUARTERS {
            let [p, q, r] = quarter.map(|corner| part.six[corner]);
            let (mut a, mut b, mut c, mut twice_area) = (zero, zero, zero, zero);
            for l in 0..LANES {
                (a[l], b[l], c[l]) = (phase[p][l] + shift[l], phase[q][l] + shift[l], phase[r][l] + shift[l]);
                let u: [f32; 3] = std::array::from_fn(|axis| place[q][axis][l] - place[p][axis][l]);
                let v: [f32; 3] = std::array::from_fn(|axis| place[r][axis][l] - place[p][axis][l]);
                let (x, y, z) = (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]);
                twice_area[l] = (x * x + y * y + z * z).sqrt();
            }
            let values = moments(&a, &b, &c);
            // From corners of the quarter to corners of the whole.
            for ((value_re, value_im), corner) in values.iter().zip([p, q, r]) {
                let [wa, wb, wc] = cut.nodes[corner];
                for l in 0..LANES {
                    let above = 1.0 + turns[0][l] * (wa * wb) + turns[1][l] * (wb * wc) + turns[2][l] * (wc * wa);
                    let area = twice_area[l] * above;
                    let (x, y) = (value_re[l] * area, value_im[l] * area);
                    for ((re, im), w) in re.iter_mut().zip(&mut im).zip([wa, wb, wc]) {
                        re[l] += x * w;
                        im[l] += y * w;
                    }
                }
            }
        }
    }
    std::array::from_fn(|l| std::array::from_fn(|i| Complex::new(re[i][l], im[i][l])))
}

/// The integral of `exp(j phase)` over an edge and what it changes by as its ends' phases do, over j, side by side.
struct Edge {
    value: (Row, Row),
    to_first: (Row, Row),
    to_second: (Row, Row),
}

impl Edge {
    #[inline(always)]
    fn new(first: &Row, second: &Row) -> Self {
        let (mut half, mut mean): (Row, Row) = Default::default();
        for i in 0..LANES {
            half[i] = 0.5 * (second[i] - first[i]);
            mean[i] = 0.5 * (first[i] + second[i]);
        }
        let (sine, cosine) = sin_cos(&half);
        let (turn_im, turn_re) = sin_cos(&mean);
        let mut edge = Edge { value: Default::default(), to_first: Default::default(), to_second: Default::default() };
        for i in 0..LANES {
            let square = half[i] * half[i];
            let near = half[i] < 0.3;
            let over = 1.0 / half[i].max(0.1);
            let far_sinc = sine[i] * over;
            let sinc = if near {
                1.0 - square * (1.0 / 6.0) * (1.0 - square * (1.0 / 20.0) * (1.0 - square * (1.0 / 42.0)))
            } else {
                far_sinc
            };
            let slope = if near {
                -half[i] * (1.0 / 3.0) * (1.0 - square * (1.0 / 10.0) * (1.0 - square * (1.0 / 28.0)))
            } else {
                (cosine[i] - far_sinc) * over
            };
            // Derivatives over j: of the turn half the value, of the sinc minus j and plus j half its slope.
            let (a, b) = (0.5 * sinc, 0.5 * slope);
            let (x, y) = (turn_re[i], turn_im[i]);
            (edge.value.0[i], edge.value.1[i]) = (x * sinc, y * sinc);
            (edge.to_first.0[i], edge.to_first.1[i]) = (x * a - y * b, y * a + x * b);
            (edge.to_second.0[i], edge.to_second.1[i]) = (x * a + y * b, y * a - x * b);
        }
        edge
    }
}

/// [`triangle::moments`] of a vector of triangles in single precision: both of its forms, and for each triangle the one that
/// holds.
#[inline(always)]
fn moments(a: &Row, b: &Row, c: &Row) -> [(Row, Row); 3] {
    let (mut low, mut middle, mut high, mut mean): (Row, Row, Row, Row) = Default::default();
    for i in 0..LANES {
        let (x, y) = (a[i].min(b[i]), a[i].max(b[i]));
        low[i] = x.min(c[i]);
        high[i] = y.max(c[i]);
        middle[i] = x.max(y.min(c[i]));
        mean[i] = (a[i] + b[i] + c[i]) * (1.0 / 3.0);
    }
    let mut near = [false; LANES];
    for i in 0..LANES {
        near[i] = high[i] - low[i] < 1.5;
    }
    // Triangles that lie side by side are mostly of one kind.
    let sorted = if near == [true; LANES] { Default::default() } else { quotients(&low, &middle, &high) };
    let mut out: [(Row, Row); 3] = Default::default();
    if near != [false; LANES] {
        let (turn_im, turn_re) = sin_cos(&mean);
        for (corner, (re, im)) in [a, b, c].into_iter().zip(&mut out) {
            series(a, b, c, &mean, corner, (&turn_re, &turn_im), (re, im));
        }
    }
    for (corner, (re, im)) in [a, b, c].into_iter().zip(&mut out) {
        for i in 0..LANES {
            let (is_low, is_high) = (corner[i] <= low[i], corner[i] >= high[i]);
            let pick = |l: f32, m: f32, h: f32| {
                if is_low {
                    l
                } else if is_high {
                    h
                } else {
                    m
                }
            };
            let far_re = pick(sorted[0].0[i], sorted[1].0[i], sorted[2].0[i]);
            let far_im = pick(sorted[0].1[i], sorted[1].1[i], sorted[2].1[i]);
            re[i] = if near[i] { re[i] } else { far_re };
            im[i] = if near[i] { im[i] } else { far_im };
        }
    }
    out
}

/// The difference of the edges' integrals over the longest difference, and its derivatives by the low, the middle and the high
/// phase, over j.
#[inline(always)]
fn quotients(low: &Row, middle: &Row, high: &Row) -> [(Row, Row); 3] {
    let (lower, upper) = (Edge::new(low, middle), Edge::new(middle, high));
    let mut sorted: [(Row, Row); 3] = Default::default();
    for i in 0..LANES {
        let over = 1.0 / (high[i] - low[i]).max(0.5);
        // Over j: minus j times.
        let whole = ((upper.value.1[i] - lower.value.1[i]) * over, -(upper.value.0[i] - lower.value.0[i]) * over);
        let divide = |x: f32, y: f32| (y * over, -x * over);
        let (x, y) = divide(-lower.to_first.0[i], -lower.to_first.1[i]);
        // The longest difference changes too; its derivative over j.
        (sorted[0].0[i], sorted[0].1[i]) = (x + whole.1 * over, y - whole.0 * over);
        let between = (upper.to_first.0[i] - lower.to_second.0[i], upper.to_first.1[i] - lower.to_second.1[i]);
        (sorted[1].0[i], sorted[1].1[i]) = divide(between.0, between.1);
        let (x, y) = divide(upper.to_second.0[i], upper.to_second.1[i]);
        (sorted[2].0[i], sorted[2].1[i]) = (x - whole.1 * over, y + whole.0 * over);
    }
    sorted
}

/// The power series about the mean of phases, in which a corner's own counts twice.
#[inline(always)]
fn series(
    a: &Row,
    b: &Row,
    c: &Row,
    mean: &Row,
    corner: &Row,
    (turn_re, turn_im): (&Row, &Row),
    (re, im): (&mut Row, &mut Row),
) {
    for i in 0..LANES {
        let (x, y, z) = (a[i] - mean[i], b[i] - mean[i], c[i] - mean[i]);
        let (e2, e3, own) = (x * y + y * z + z * x, x * y * z, corner[i] - mean[i]);
        let h2 = -e2;
        let h3 = e3;
        let h4 = e2 * e2;
        let h5 = -2.0 * e2 * e3;
        let h6 = -e2 * h4 + e3 * h3;
        let h7 = -e2 * h5 + e3 * h4;
        let h8 = -e2 * h6 + e3 * h5;
        let t1 = own;
        let t2 = h2 + own * t1;
        let t3 = h3 + own * t2;
        let t4 = h4 + own * t3;
        let t5 = h5 + own * t4;
        let t6 = h6 + own * t5;
        let t7 = h7 + own * t6;
        let t8 = h8 + own * t7;
        let t9 = own * t8;
        let even =
            1.0 / 6.0 - t2 * (1.0 / 120.0) + t4 * (1.0 / 5040.0) - t6 * (1.0 / 362_880.0) + t8 * (1.0 / 39_916_800.0);
        let odd = t1 * (1.0 / 24.0) - t3 * (1.0 / 720.0) + t5 * (1.0 / 40_320.0) - t7 * (1.0 / 3_628_800.0)
            + t9 * (1.0 / 479_001_600.0);
        re[i] = even * turn_re[i] - odd * turn_im[i];
        im[i] = even * turn_im[i] + odd * turn_re[i];
    }
}

/// Sines and cosines of a vector to a few units of the seventh digit: by the half angle's series and its doubling.
#[inline(always)]
fn sin_cos(x: &Row) -> (Row, Row) {
    /// 1.5 times 2^23: adding it leaves the nearest integer in a number's last bits.
    const SHIFT: f32 = 12_582_912.0;
    let (mut sines, mut cosines): (Row, Row) = Default::default();
    for i in 0..LANES {
        let turns = x[i] * std::f32::consts::FRAC_1_PI * 0.5;
        let whole = (turns + SHIFT) - SHIFT;
        // 2 pi in two pieces, so that the reduction loses nothing.
        let reduced = (x[i] - whole * 6.281_25) - whole * 1.935_307_2e-3;
        let y = 0.5 * reduced;
        let z = y * y;
        let sine = y
            * (1.0
                + z * (-1.0 / 6.0
                    + z * (1.0 / 120.0 + z * (-1.0 / 5040.0 + z * (1.0 / 362_880.0 - z * (1.0 / 39_916_800.0))))));
        let cosine =
            1.0 + z * (-0.5 + z * (1.0 / 24.0 + z * (-1.0 / 720.0 + z * (1.0 / 40_320.0 - z * (1.0 / 3_628_800.0)))));
        sines[i] = 2.0 * sine * cosine;
        cosines[i] = 1.0 - 2.0 * sine * sine;
    }
    (sines, cosines)
}

/// [`Integrator::moments`] the slow and obvious way: double precision, linear strength in each of the flat triangles, paths as
/// plain distances.
pub fn exact_moments(
    triangle: &CurvedTriangle,
    antennas: [DVec3; 2],
    wavenumber_per_m: f64,
    cuts: usize,
) -> [Complex64; 3] {
    let cut = Cut::new(cuts);
    let length = |p: DVec3| antennas.iter().map(|a| a.distance(p)).sum::<f64>();
    let start = length(triangle.middle);
    let places: Vec<DVec3> = cut.nodes.iter().map(|w| triangle.place(*w).as_dvec3()).collect();
    let phases: Vec<f64> = places.iter().map(|p| -wavenumber_per_m * (length(triangle.middle + *p) - start)).collect();
    let mut sums = [Complex64::ZERO; 3];
    let quarters = cut.parts.iter().flat_map(|part| QUARTERS.map(|corners| corners.map(|corner| part.six[corner])));
    for [p, q, r] in quarters {
        let twice_area = (places[q] - places[p]).cross(places[r] - places[p]).length();
        let moments = triangle::moments(phases[p], phases[q], phases[r]);
        for (node, moment) in [p, q, r].into_iter().zip(moments) {
            let [a, b, c] = cut.nodes[node];
            let [ab, bc, ca] = triangle.turns;
            let above = f64::from(1.0 + ab * a * b + bc * b * c + ca * c * a);
            for (sum, w) in sums.iter_mut().zip([a, b, c]) {
                *sum += moment * twice_area * above * f64::from(w);
            }
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use rand::Rng;

    use super::*;
    use crate::random::{Purpose, generator};

    const K: f64 = 1_257.507_013_171_009;

    /// Triangles of a limb or a trunk a few metres away, at any angle.
    fn triangles() -> Vec<(CurvedTriangle, [DVec3; 2])> {
        let mut rng = generator(11, Purpose::Noise, [0, 0]);
        let mut vector = |size: f64| {
            DVec3::new(rng.random_range(-size..size), rng.random_range(-size..size), rng.random_range(-size..size))
        };
        // Normals that turn by some degrees.
        let turn = |i: u32| DVec3::new(1.0, 0.1 * f64::from(i), 0.15 - 0.1 * f64::from(i)).normalize();
        (0..200)
            .map(|_| {
                let middle = DVec3::new(3.0, 0.5, 1.0) + vector(0.5);
                let corners = [0; 3].map(|_| middle + vector(0.012));
                let bulges = [0; 3].map(|_| vector(6e-4));
                let antenna = vector(0.5);
                (CurvedTriangle::new(corners, [0, 1, 2].map(turn), bulges), [antenna, antenna + vector(0.003)])
            })
            .collect()
    }

    fn of(triangle: &CurvedTriangle, antennas: [DVec3; 2], level: KernelLevel, cuts: usize) -> [Complex<f32>; 3] {
        let [tx, rx] = antennas.map(|a| View::new(a, triangle.middle));
        let mut out = Vec::new();
        Integrator { level, ..Integrator::default() }.moments(&[(*triangle, tx, rx)], K, cuts, &mut out);
        out[0]
    }

    /// What is bent away inside each piece falls faster than with the square of its size.
    #[test]
    fn cuts_converge_to_the_integral() {
        let (mut coarse, mut fine, mut all) = (0.0, 0.0, 0.0);
        for (triangle, antennas) in triangles() {
            let exact = exact_moments(&triangle, antennas, K, 24);
            let miss = |cuts: usize| {
                let found = of(&triangle, antennas, KernelLevel::Portable, cuts);
                (0..3)
                    .map(|i| (exact[i] - Complex64::new(found[i].re.into(), found[i].im.into())).norm_sqr())
                    .sum::<f64>()
            };
            coarse += miss(2);
            fine += miss(6);
            all += exact.iter().map(Complex64::norm_sqr).sum::<f64>();
        }
        let (coarse, fine) = ((coarse / all).sqrt(), (fine / all).sqrt());
        assert!(fine < 0.006 && coarse / fine > 9.0, "{coarse} {fine}");
    }

    #[test]
    fn every_level_of_instructions_computes_the_same() {
        for (triangle, antennas) in triangles() {
            let portable = of(&triangle, antennas, KernelLevel::Portable, 3);
            for level in KernelLevel::ALL.into_iter().filter(|level| level.is_available()) {
                assert_eq!(of(&triangle, antennas, level, 3), portable, "{level}");
            }
        }
    }

    mod hard_cases {
        use super::*;

        /// Phases that agree, that agree pairwise, at the seam of both forms, and many turns apart.
        #[test]
        fn single_precision_is_double_precision_in_every_direction() {
            let mut worst: f64 = 0.0;
            for i in 0..400 {
                let span = 10f64.powf(-7.0 + 0.0225 * f64::from(i));
                for (b, c) in [(0.0, 0.0), (0.0, 1.0), (1.0, 1.0), (0.5, 1.0), (1e-3, 1.0), (0.999, 1.0), (-1.0, 1.0)] {
                    let phases = [0.3, 0.3 + b * span, 0.3 + c * span].map(|p: f64| p as f32);
                    let [a, b, c] = phases;
                    let found = moments(&[a; LANES], &[b; LANES], &[c; LANES]);
                    let exact = triangle::moments(a.into(), b.into(), c.into());
                    for (exact, (re, im)) in exact.iter().zip(&found) {
                        worst = worst.max((exact - Complex64::new(re[0].into(), im[0].into())).norm() / 0.5);
                    }
                }
            }
            assert!(worst < 2e-6, "{worst:e}");
        }

        #[test]
        fn a_point_and_a_needle_are_no_surface() {
            let antennas = [DVec3::ZERO, DVec3::Y * 0.003];
            let corner = DVec3::new(2.0, 0.0, 0.0);
            for corners in [[corner; 3], [corner, corner + DVec3::Z * 0.02, corner + DVec3::Z * 0.01]] {
                let triangle = CurvedTriangle::new(corners, [DVec3::X; 3], [DVec3::ZERO; 3]);
                for moment in of(&triangle, antennas, KernelLevel::detect(), 2) {
                    assert!(moment.norm() < 1e-9, "{moment}");
                }
            }
        }
    }
}
