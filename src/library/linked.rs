//! Finds what links between parts demand together: which parts must have one label, which must
//! differ, and which demands a new link would contradict.
//!
//! Two ends of links are one part if they share most of the smaller one's polygons. So a part stays
//! linked when labels change and parts are numbered again.

use super::error::Result;
use super::rows::damaged;
use super::sources::{Known, Sources};
use super::types::LabelId;
use crate::labels::{LinkedFaces, Links};
use crate::pipeline::proxy_pins;
use crate::segmentation::Surface;
use crate::store::{LinkEnd, LinkRow, ShapeId};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// Number of rings of faces at the boundary of a linked part that are not bound, so that the
/// boundary can still move.
const FREE_RINGS: usize = 2;

/// What a link demands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum LinkKind {
    /// The parts have the same label.
    Same,
    /// The parts have different labels.
    Differ,
}

impl LinkKind {
    /// Returns the stored name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Same => "same",
            Self::Differ => "differ",
        }
    }

    /// Returns the kind with this stored name.
    pub fn of_name(name: &str) -> Option<Self> {
        [Self::Same, Self::Differ]
            .into_iter()
            .find(|kind| kind.name() == name)
    }

    /// Returns whether two labels are as demanded.
    pub(super) fn allows(self, a: i32, b: i32) -> bool {
        (a == b) == (self == Self::Same)
    }
}

/// A part of a shape.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PartName {
    /// The shape.
    pub shape: String,
    /// The part, numbered as in [`ShapeInfo::parts`](super::ShapeInfo::parts).
    pub part: u32,
}

/// A linked part.
struct Node {
    shape: ShapeId,
    /// Its number when it was first linked.
    part: u32,
    polygons: BTreeSet<u32>,
    /// The label that a person gave most of it.
    label: Option<i32>,
}

/// A link between two nodes.
struct Edge {
    id: i64,
    kind: LinkKind,
    nodes: [usize; 2],
    /// Whether labels that persons gave contradict it.
    overruled: bool,
}

/// The links of a collection, with the labels that persons gave to linked parts.
pub(super) struct Linked {
    nodes: Vec<Node>,
    edges: Vec<Edge>,
    /// The smallest node of those that must have the label of this node.
    group: Vec<usize>,
}

/// A step from one part to another that must have the same label, and the link that demands it.
type Step = (usize, usize, i64);

impl Linked {
    /// Reads what some links demand, the oldest first, under the labels that persons gave.
    pub(super) fn new(sources: &dyn Sources, links: &[LinkRow]) -> Result<Self> {
        let mut pins = BTreeMap::new();
        for shape in linked_shapes(links) {
            if let Some(of_shape) = sources.pins(shape)? {
                pins.insert(shape, of_shape);
            }
        }
        Self::under(&pins, links, &[])
    }

    /// Reads what some links demand, under the labels that persons gave to polygons of shapes.
    /// `further` are parts that may be linked next.
    pub(super) fn under(
        pins: &BTreeMap<ShapeId, Vec<i32>>,
        links: &[LinkRow],
        further: &[LinkEnd],
    ) -> Result<Self> {
        let mut linked = Self {
            nodes: Vec::new(),
            edges: Vec::new(),
            group: Vec::new(),
        };
        for link in links {
            let edge = Edge {
                id: link.id,
                kind: kind_of(link)?,
                nodes: [linked.node(&link.ends[0]), linked.node(&link.ends[1])],
                overruled: false,
            };
            linked.edges.push(edge);
        }
        for end in further {
            linked.node(end);
        }
        for node in &mut linked.nodes {
            node.label = pins.get(&node.shape).and_then(|p| given_label(node, p));
        }
        linked.settle();
        Ok(linked)
    }

    /// Returns the node of an end of a link, which is added if there is none.
    fn node(&mut self, end: &LinkEnd) -> usize {
        if let Some(at) = self.find(end) {
            self.nodes[at].polygons.extend(&end.polygons);
            return at;
        }
        self.nodes.push(Node {
            shape: end.shape,
            part: end.part,
            polygons: end.polygons.iter().copied().collect(),
            label: None,
        });
        self.nodes.len() - 1
    }

    /// Returns the node that shares most of the polygons of an end, or of which the end has most.
    pub(super) fn find(&self, end: &LinkEnd) -> Option<usize> {
        let is_same = |node: &Node| {
            let common = end.polygons.iter().filter(|p| node.polygons.contains(p));
            let smaller = node.polygons.len().min(end.polygons.len());
            node.shape == end.shape && 2 * common.count() > smaller
        };
        self.nodes.iter().position(is_same)
    }

    /// Groups the nodes that must have one label, and finds the links that persons overruled by
    /// labels.
    fn settle(&mut self) {
        self.group = (0..self.nodes.len()).collect();
        let mut labels: Vec<Option<i32>> = self.nodes.iter().map(|n| n.label).collect();
        for edge in self.edges.iter_mut().filter(|e| e.kind == LinkKind::Same) {
            let [a, b] = edge.nodes.map(|n| self.group[n]);
            edge.overruled = matches!((labels[a], labels[b]), (Some(a), Some(b)) if a != b);
            if edge.overruled {
                continue;
            }
            let (first, second) = (a.min(b), a.max(b));
            labels[first] = labels[first].or(labels[second]);
            self.group.iter_mut().for_each(|g| {
                if *g == second {
                    *g = first;
                }
            });
        }
        for edge in self.edges.iter_mut().filter(|e| e.kind == LinkKind::Differ) {
            let [a, b] = edge.nodes.map(|n| self.group[n]);
            let equal = matches!((labels[a], labels[b]), (Some(a), Some(b)) if a == b);
            edge.overruled = equal || a == b;
        }
    }

    /// Returns the ids of the links that labels of persons contradict.
    pub(super) fn overruled(&self) -> BTreeSet<i64> {
        let overruled = self.edges.iter().filter(|e| e.overruled);
        overruled.map(|e| e.id).collect()
    }

    /// Returns the label that a person gave to a group, with the node to which it was given.
    fn label_of(&self, node: usize) -> Option<(usize, i32)> {
        let in_group = (0..self.nodes.len()).filter(|n| self.group[*n] == self.group[node]);
        let mut labelled = in_group.filter_map(|n| Some((n, self.nodes[n].label?)));
        labelled.next()
    }

    /// Returns the chain of demands that a new link between two nodes contradicts, in words; `None`
    /// if it contradicts nothing. `name` names the shape of a part.
    pub(super) fn contradiction(
        &self,
        kind: LinkKind,
        [a, b]: [usize; 2],
        name: &dyn Fn(ShapeId) -> String,
    ) -> Option<String> {
        let part = |n: usize| format!("{}:{}", name(self.nodes[n].shape), self.nodes[n].part);
        let same = |steps: Vec<Step>| -> Vec<String> {
            let text = |(from, to, id): &Step| {
                format!("{} has the label of {} (link {id})", part(*from), part(*to))
            };
            steps.iter().map(text).collect()
        };
        let together = self.group[a] == self.group[b];
        let given = (self.label_of(a), self.label_of(b));
        let chain = match kind {
            LinkKind::Same if together => return None,
            LinkKind::Differ if together => same(self.path(a, b)),
            LinkKind::Same => match self.differing(a, b) {
                Some((x, y, id)) => {
                    let mut chain = same(self.path(a, x));
                    let (x, y_name) = (part(x), part(y));
                    chain.push(format!("{x} has another label than {y_name} (link {id})"));
                    chain.extend(same(self.path(y, b)));
                    chain
                }
                None => Vec::new(),
            },
            LinkKind::Differ => Vec::new(),
        };
        if !chain.is_empty() {
            return Some(chain.join(", "));
        }
        let ((x, label_a), (y, label_b)) = (given.0?, given.1?);
        if kind.allows(label_a, label_b) {
            return None;
        }
        let mut chain = same(self.path(a, x));
        chain.push(format!("a person gave {} label {label_a}", part(x)));
        chain.push(format!("a person gave {} label {label_b}", part(y)));
        chain.extend(same(self.path(y, b)));
        Some(chain.join(", "))
    }

    /// Returns the oldest link by which the groups of two nodes differ, from the first's side.
    fn differing(&self, a: usize, b: usize) -> Option<Step> {
        let groups = [self.group[a], self.group[b]];
        let differ = self
            .edges
            .iter()
            .filter(|e| e.kind == LinkKind::Differ && !e.overruled);
        differ
            .flat_map(|e| {
                [
                    (e.nodes[0], e.nodes[1], e.id),
                    (e.nodes[1], e.nodes[0], e.id),
                ]
            })
            .find(|(x, y, _)| [self.group[*x], self.group[*y]] == groups)
    }

    /// Returns a shortest chain of links that give two nodes of a group one label.
    fn path(&self, from: usize, to: usize) -> Vec<Step> {
        let mut before: Vec<Option<(usize, i64)>> = vec![None; self.nodes.len()];
        let mut reached = VecDeque::from([from]);
        while let Some(node) = reached.pop_front() {
            if node == to {
                break;
            }
            let same = self
                .edges
                .iter()
                .filter(|e| e.kind == LinkKind::Same && !e.overruled);
            for edge in same.filter(|e| e.nodes.contains(&node)) {
                let next = edge.nodes[usize::from(edge.nodes[0] == node)];
                if next != from && before[next].is_none() {
                    before[next] = Some((node, edge.id));
                    reached.push_back(next);
                }
            }
        }
        let mut steps = Vec::new();
        let mut at = to;
        while let Some((previous, id)) = before[at].filter(|_| at != from) {
            steps.push((previous, at, id));
            at = previous;
        }
        steps.reverse();
        steps
    }

    /// Returns what the links demand of the faces of some shapes. `labels` are the labels of the
    /// classes; a group gets the class of the label that a person gave some of it.
    pub(super) fn demands(
        &self,
        sources: &dyn Sources,
        shapes: &[&Known],
        labels: &[LabelId],
    ) -> Links {
        let mut taken = BTreeSet::new();
        let mut groups = BTreeMap::<usize, LinkedFaces>::new();
        for (n, node) in self.nodes.iter().enumerate() {
            let Some(at) = shapes.iter().position(|k| k.row.id == node.shape) else {
                continue;
            };
            let group = groups.entry(self.group[n]).or_default();
            let faces = inner_faces(&sources.surface(shapes[at].file()), shapes[at], node);
            let faces = faces.into_iter().map(|face| (at, face));
            group.faces.extend(faces.filter(|f| taken.insert(*f)));
            group.class = self.label_of(n).and_then(|(_, label)| {
                let class = labels
                    .iter()
                    .position(|l| i64::from(*l) == i64::from(label));
                class.map(|c| c as u32)
            });
        }
        let place: BTreeMap<usize, usize> = groups
            .keys()
            .enumerate()
            .map(|(place, g)| (*g, place))
            .collect();
        let differ = self
            .edges
            .iter()
            .filter(|e| e.kind == LinkKind::Differ && !e.overruled);
        let apart = differ.filter_map(|e| {
            let [a, b] = e.nodes.map(|n| place.get(&self.group[n]).copied());
            Some([a?, b?])
        });
        Links {
            apart: apart.collect(),
            groups: groups.into_values().collect(),
        }
    }

    /// Returns the smallest number of labels that the links need; `None` if it is above `limit`.
    pub(super) fn fewest_labels(&self, limit: usize) -> Option<usize> {
        let roots: BTreeSet<usize> = self.group.iter().copied().collect();
        let place = |n: usize| roots.iter().position(|g| *g == self.group[n]);
        let differ = self
            .edges
            .iter()
            .filter(|e| e.kind == LinkKind::Differ && !e.overruled);
        let apart = differ.filter_map(|e| Some([place(e.nodes[0])?, place(e.nodes[1])?]));
        let links = Links {
            apart: apart.collect(),
            groups: vec![LinkedFaces::default(); roots.len()],
        };
        links.fewest_classes(limit)
    }
}

/// Returns the label that a person gave most polygons of a part.
fn given_label(node: &Node, pins: &[i32]) -> Option<i32> {
    let given = node.polygons.iter().filter_map(|p| pins.get(*p as usize));
    let mut counts = BTreeMap::<i32, usize>::new();
    given
        .filter(|l| **l >= 0)
        .for_each(|l| *counts.entry(*l).or_default() += 1);
    let most = counts.into_iter().max_by_key(|(label, n)| (*n, -label))?;
    (2 * most.1 > node.polygons.len()).then_some(most.0)
}

/// Returns what a link demands.
pub(super) fn kind_of(link: &LinkRow) -> Result<LinkKind> {
    let unknown = || {
        let message = format!("{:?} is no kind of link", link.kind);
        damaged(&format!("links {}", link.id), &message)
    };
    LinkKind::of_name(&link.kind).ok_or_else(unknown)
}

/// Returns the shapes whose parts are linked.
pub(super) fn linked_shapes(links: &[LinkRow]) -> BTreeSet<ShapeId> {
    links
        .iter()
        .flat_map(|l| &l.ends)
        .map(|e| e.shape)
        .collect()
}

/// Returns the label of most of some polygons; `None` without polygons.
pub(super) fn label_of_most(polygons: &[u32], labels: &[i32]) -> Option<i32> {
    let mut counts = BTreeMap::<i32, usize>::new();
    let found = polygons.iter().filter_map(|p| labels.get(*p as usize));
    found.for_each(|l| *counts.entry(*l).or_default() += 1);
    let most = counts.into_iter().max_by_key(|(label, n)| (*n, -label));
    most.map(|m| m.0)
}

/// Returns the proxy faces of a part that a link binds: without the outermost rings, as long as
/// most of the part's area and of its polygons remain.
fn inner_faces(surface: &Surface, shape: &Known, node: &Node) -> Vec<u32> {
    let view = shape.view();
    let is_in = |p: u32| node.polygons.contains(&p).then_some(0);
    let of_polygon: Vec<Option<u32>> = (0..view.face_map.len() as u32).map(is_in).collect();
    let mut bound: Vec<bool> = proxy_pins(&view, &of_polygon, 1)
        .into_iter()
        .map(|c| c.is_some())
        .collect();
    if !bound.contains(&true) {
        // A part smaller than any face of the proxy binds those that stand for it.
        node.polygons
            .iter()
            .filter_map(|p| view.face_map.get(*p as usize))
            .for_each(|face| bound[*face as usize] = true);
    }
    let area = |bound: &[bool]| -> f64 {
        let faces = bound.iter().zip(&surface.area).filter(|f| *f.0);
        faces.map(|f| f.1).sum()
    };
    let n_polygons = |bound: &[bool]| {
        let bound = |p: &&u32| bound[view.face_map[**p as usize] as usize];
        node.polygons.iter().filter(bound).count()
    };
    let (whole, n) = (area(&bound), n_polygons(&bound));
    for _ in 0..FREE_RINGS {
        let mut inner = bound.clone();
        for edge in &surface.edges {
            let [a, b] = edge.faces.map(|f| f as usize);
            if bound[a] != bound[b] {
                (inner[a], inner[b]) = (false, false);
            }
        }
        if 2.0 * area(&inner) <= whole || 2 * n_polygons(&inner) <= n {
            break;
        }
        bound = inner;
    }
    let faces = (0..bound.len() as u32).filter(|f| bound[*f as usize]);
    faces.collect()
}
