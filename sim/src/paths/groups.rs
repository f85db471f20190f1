//! Groups of items that coincide within a tolerance.

/// Groups items that are the same, given by their coordinates along some axis. Items that are the same lie within
/// `tolerance` of each other there.
///
/// In the order of coordinates and then of indices, each item joins the first group whose first member is the same, or
/// begins a group.
pub(super) fn groups(coordinates: &[f64], tolerance: f64, is_same: impl Fn(usize, usize) -> bool) -> Vec<Vec<usize>> {
    let mut order: Vec<usize> = (0..coordinates.len()).collect();
    order.sort_by(|&i, &j| coordinates[i].total_cmp(&coordinates[j]).then(i.cmp(&j)));
    let mut groups: Vec<Vec<usize>> = Vec::new();
    let mut recent: Vec<usize> = Vec::new();
    for i in order {
        recent.retain(|&group| coordinates[i] - coordinates[groups[group][0]] <= tolerance);
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
