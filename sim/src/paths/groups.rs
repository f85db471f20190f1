//! Groups of things that coincide within a tolerance.

/// Groups things, of which those that are the same lie within `reach` of each other along some axis. `places` are their
/// coordinates there. In the order of coordinates and then of numbers, each thing joins the first group whose first
/// member is the same, or begins a group.
pub(super) fn groups(places: &[f64], reach: f64, is_same: impl Fn(usize, usize) -> bool) -> Vec<Vec<usize>> {
    let mut order: Vec<usize> = (0..places.len()).collect();
    order.sort_by(|&i, &j| places[i].total_cmp(&places[j]).then(i.cmp(&j)));
    let mut groups: Vec<Vec<usize>> = Vec::new();
    let mut recent: Vec<usize> = Vec::new();
    for i in order {
        recent.retain(|&group| places[i] - places[groups[group][0]] <= reach);
        match recent.iter().copied().find(|&group| is_same(i, groups[group][0])) {
            Some(group) => groups[group].push(i),
            None => {
                recent.push(groups.len());
                groups.push(vec![i]);
            }
        }
    }
    groups
}
