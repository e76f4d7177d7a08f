//! Demands of a person on a labelling: parts that must have one label, and parts that must have
//! different labels. They become the class of each such group of parts, of least total cost.
//!
//! Choosing the classes is a weighted colouring of the graph of pairs that must differ. It is
//! solved by branch and bound. A person links a handful of parts, so the search is short; where it
//! is not, it ends after a fixed number of steps with the best classes found so far.

use crate::segmentation::Surface;
use std::collections::{BTreeMap, BTreeSet};

/// Number of steps after which a search for classes ends.
const MAX_STEPS: usize = 50_000;

/// Faces that must have one label, on one shape or on several.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LinkedFaces {
    /// Index of the shape and of the face, or of the patch.
    pub faces: Vec<(usize, u32)>,
    /// The class that they must have, because a person labelled some of them.
    pub class: Option<u32>,
}

/// Groups of faces, each of which must have one label, and pairs of groups that must have different
/// ones.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Links {
    /// The groups. No face is in two of them.
    pub groups: Vec<LinkedFaces>,
    /// Pairs of groups that must differ; the oldest demand first.
    pub apart: Vec<[usize; 2]>,
}

impl Links {
    /// Whether nothing is demanded.
    pub fn is_empty(&self) -> bool {
        self.groups.is_empty()
    }

    /// Returns the smallest number of classes, up to `limit`, with which all demands can be met.
    /// Returns `None` if `limit` classes are too few.
    pub fn fewest_classes(&self, limit: usize) -> Option<usize> {
        let fits = |k: &usize| {
            let costs = vec![0.0; self.groups.len() * k];
            self.colouring(&self.apart, &costs, *k).is_some()
        };
        (1..=limit).find(fits)
    }

    /// Returns the class of each group. `costs (n_groups, k)` are the costs of each class for each
    /// group, and their sum is the least possible. If `k` classes are too few, the newest demands
    /// for difference are given up until they suffice.
    pub fn classes(&self, costs: &[f64], k: usize) -> Vec<u32> {
        let mut n = self.apart.len();
        loop {
            match self.colouring(&self.apart[..n], costs, k) {
                Some(classes) => return classes,
                None if n == 0 => return vec![0; self.groups.len()],
                None => n -= 1,
            }
        }
    }

    /// Returns the cost of each class for each group `(n_groups, k)`: `cost(shape, face, class)`,
    /// summed over the faces of the group.
    pub fn costs(&self, k: usize, cost: impl Fn(usize, u32, usize) -> f64) -> Vec<f64> {
        let of_group = |group: &LinkedFaces| {
            let mut sums = vec![0.0; k];
            for &(shape, face) in &group.faces {
                for (class, sum) in sums.iter_mut().enumerate() {
                    *sum += cost(shape, face, class);
                }
            }
            sums
        };
        self.groups.iter().flat_map(of_group).collect()
    }

    /// Returns the class of each face of each shape, as far as its group decides it. `sizes` are
    /// the numbers of faces.
    pub fn fixed(&self, classes: &[u32], sizes: &[usize]) -> Vec<Vec<Option<u32>>> {
        let mut fixed: Vec<Vec<Option<u32>>> = sizes.iter().map(|n| vec![None; *n]).collect();
        for (group, class) in self.groups.iter().zip(classes) {
            for &(shape, face) in &group.faces {
                fixed[shape][face as usize] = Some(*class);
            }
        }
        fixed
    }

    /// Returns the class of each face that a group decides, for each shape; `None` for a shape
    /// without linked faces. `evidence` are the costs `(m, k)` of a shape's faces, in nats; the
    /// classes are those of least total cost by area.
    pub fn decided(
        &self,
        surfaces: &[&Surface],
        k: usize,
        evidence: impl Fn(usize) -> Vec<f64>,
    ) -> Vec<Option<Vec<Option<u32>>>> {
        if self.is_empty() {
            return vec![None; surfaces.len()];
        }
        let faces = self.groups.iter().flat_map(|g| &g.faces);
        let linked: BTreeSet<usize> = faces.map(|f| f.0).collect();
        let evidence: BTreeMap<usize, Vec<f64>> = linked
            .iter()
            .map(|shape| (*shape, evidence(*shape)))
            .collect();
        let costs = self.costs(k, |shape, face, class| {
            surfaces[shape].area[face as usize] * evidence[&shape][face as usize * k + class]
        });
        let sizes: Vec<usize> = surfaces.iter().map(|s| s.n_faces()).collect();
        let fixed = self.fixed(&self.classes(&costs, k), &sizes);
        let fixed = fixed.into_iter().enumerate();
        fixed
            .map(|(shape, fixed)| linked.contains(&shape).then_some(fixed))
            .collect()
    }

    /// Changes a labelling with `k` labels as little as possible so that it meets the demands.
    /// `area(shape, face)` weighs the faces.
    pub fn repair(&self, labels: &mut [Vec<u32>], k: usize, area: impl Fn(usize, u32) -> f64) {
        if self.is_empty() {
            return;
        }
        let costs = self.costs(k, |shape, face, class| {
            let agrees = labels[shape][face as usize] as usize == class;
            if agrees { 0.0 } else { area(shape, face) }
        });
        let classes = self.classes(&costs, k);
        for (group, class) in self.groups.iter().zip(classes) {
            for &(shape, face) in &group.faces {
                labels[shape][face as usize] = class;
            }
        }
    }

    /// Returns the classes of least cost with which all pairs of `apart` differ; `None` if there
    /// are none.
    fn colouring(&self, apart: &[[usize; 2]], costs: &[f64], k: usize) -> Option<Vec<u32>> {
        let n = self.groups.len();
        let mut search = Search {
            k,
            costs,
            neighbours: vec![Vec::new(); n],
            order: (0..n).collect(),
            allowed: self.groups.iter().map(|g| g.class).collect(),
            left: Vec::new(),
            classes: vec![None; n],
            best: None,
            n_steps: 0,
        };
        for &[a, b] in apart {
            if a == b {
                return None;
            }
            search.neighbours[a].push(b);
            search.neighbours[b].push(a);
        }
        let neighbours = &search.neighbours;
        search.order.sort_by_key(|g| {
            let is_given = self.groups[*g].class.is_some();
            (!is_given, std::cmp::Reverse(neighbours[*g].len()), *g)
        });
        // The least cost of the groups from each place in the order on.
        let mut left = vec![0.0; n + 1];
        for (place, group) in search.order.iter().enumerate().rev() {
            let least = search.classes_of(*group).next().map_or(0.0, |c| c.1);
            left[place] = left[place + 1] + least;
        }
        search.left = left;
        search.descend(0, 0.0);
        search.best.map(|(_, classes)| classes)
    }
}

/// A search for the classes of least cost.
struct Search<'a> {
    k: usize,
    costs: &'a [f64],
    neighbours: Vec<Vec<usize>>,
    order: Vec<usize>,
    /// The class that a group must have, if a person gave one.
    allowed: Vec<Option<u32>>,
    left: Vec<f64>,
    classes: Vec<Option<u32>>,
    best: Option<(f64, Vec<u32>)>,
    n_steps: usize,
}

impl Search<'_> {
    /// Returns the classes that a group may have with their costs, cheapest first.
    fn classes_of(&self, group: usize) -> std::vec::IntoIter<(u32, f64)> {
        let allowed = self.allowed[group];
        let of_group = self.costs[group * self.k..(group + 1) * self.k].iter();
        let classes = of_group
            .enumerate()
            .map(|(class, cost)| (class as u32, *cost));
        let mut classes: Vec<(u32, f64)> = classes
            .filter(|c| allowed.is_none_or(|class| class == c.0))
            .collect();
        classes.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        classes.into_iter()
    }

    fn descend(&mut self, place: usize, cost: f64) {
        let is_better = |best: &Option<(f64, Vec<u32>)>, cost: f64| {
            best.as_ref().is_none_or(|(least, _)| cost < *least)
        };
        self.n_steps += 1;
        if self.n_steps > MAX_STEPS || !is_better(&self.best, cost + self.left[place]) {
            return;
        }
        let Some(&group) = self.order.get(place) else {
            let classes = self.classes.iter().copied().map(Option::unwrap_or_default);
            self.best = Some((cost, classes.collect()));
            return;
        };
        for (class, more) in self.classes_of(group) {
            let is_taken = |other: &usize| self.classes[*other] == Some(class);
            if self.neighbours[group].iter().any(is_taken) {
                continue;
            }
            self.classes[group] = Some(class);
            self.descend(place + 1, cost + more);
            self.classes[group] = None;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn groups(n: usize) -> Vec<LinkedFaces> {
        let group = |g| LinkedFaces {
            faces: vec![(0, g as u32)],
            class: None,
        };
        (0..n).map(group).collect()
    }

    #[test]
    fn groups_take_the_classes_of_least_total_cost_that_differ() {
        let links = Links {
            groups: groups(2),
            apart: vec![[0, 1]],
        };
        // Both prefer class 0; it costs the first little to give way, although it comes first.
        let costs = [1.0, 2.0, 9.0, 0.0, 50.0, 90.0];
        assert_eq!(links.classes(&costs, 3), [1, 0]);
        let free = Links {
            apart: Vec::new(),
            ..links
        };
        assert_eq!(free.classes(&costs, 3), [0, 0]);
    }

    #[test]
    fn a_given_class_is_kept_whatever_it_costs() {
        let mut links = Links {
            groups: groups(2),
            apart: vec![[0, 1]],
        };
        links.groups[1].class = Some(0);
        assert_eq!(links.classes(&[0.0, 5.0, 100.0, 0.0], 2), [1, 0]);
    }

    #[test]
    fn the_number_of_classes_that_pairs_need_is_known() {
        let triangle = Links {
            groups: groups(3),
            apart: vec![[0, 1], [1, 2], [0, 2]],
        };
        assert_eq!(triangle.fewest_classes(8), Some(3));
        assert_eq!(triangle.fewest_classes(2), None);
        // The newest demand is given up if there are too few classes.
        let classes = triangle.classes(&[0.0; 6], 2);
        assert!(classes[0] != classes[1] && classes[1] != classes[2]);
        assert_eq!(classes[0], classes[2]);
        let impossible = Links {
            groups: groups(1),
            apart: vec![[0, 0]],
        };
        assert_eq!(impossible.fewest_classes(8), None);
    }

    #[test]
    fn a_labelling_is_repaired_where_the_least_area_changes() {
        let mut links = Links {
            groups: groups(2),
            apart: vec![[0, 1]],
        };
        links.groups[0].faces.extend([(1, 0), (1, 1)]);
        let mut labels = vec![vec![0, 1, 2], vec![1, 1, 0]];
        let area = |shape, face| if (shape, face) == (0, 0) { 9.0 } else { 1.0 };
        links.repair(&mut labels, 3, area);
        // The first group keeps the label of its large face, and the second one had another one.
        assert_eq!(labels, [vec![0, 1, 2], vec![0, 0, 0]]);
        let unchanged = labels.clone();
        links.repair(&mut labels, 3, area);
        assert_eq!(labels, unchanged);
        labels[0][1] = 0;
        links.repair(&mut labels, 3, area);
        assert_ne!(labels[0][0], labels[0][1]);
        Links::default().repair(&mut labels, 3, area);
    }
}
