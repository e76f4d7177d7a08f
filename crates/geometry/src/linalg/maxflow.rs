//! Computes minimum cuts of sparse graphs by two search trees that persist from path to path
//! (Boykov and Kolmogorov 2004, *An Experimental Comparison of Min-Cut/Max-Flow Algorithms*), with
//! integer capacities, hence exactly and deterministically. On the bands and surfaces of this crate
//! it is many times faster than augmenting along shortest paths.

use std::collections::VecDeque;

/// A flow network over `n` nodes with a source and a sink of its own.
#[derive(Debug, Clone)]
pub struct Network {
    /// Tail, head, capacity there and back.
    edges: Vec<(u32, u32, i64, i64)>,
    /// Capacity left from the source to each node; where negative, the capacity left from the node
    /// to the sink.
    terminal: Vec<i64>,
}

/// No arc: the node is in neither tree.
const FREE: u32 = u32::MAX;
/// The node hangs on the source or the sink itself.
const ROOT: u32 = u32::MAX - 1;
/// The node has lost its arc to the root and looks for another.
const ORPHAN: u32 = u32::MAX - 2;

impl Network {
    /// A network of `n` nodes and no arcs.
    ///
    /// ```
    /// use coseg_geometry::linalg::maxflow::Network;
    ///
    /// // Nodes 0 and 2 want to be apart; the weaker of the two edges between them is cut.
    /// let mut network = Network::new(3);
    /// network.terminal(0, 10, 0);
    /// network.terminal(2, 0, 10);
    /// network.edge(0, 1, 3, 3);
    /// network.edge(1, 2, 2, 2);
    /// assert_eq!(network.sink_side(), [false, false, true]);
    /// ```
    pub fn new(n: usize) -> Self {
        Self {
            edges: Vec::new(),
            terminal: vec![0; n],
        }
    }

    /// Adds arcs `from → to` and `to → from` with the given capacities: the cost of a cut with
    /// `from` on the source side and `to` on the sink side, and of the opposite cut. A loop is
    /// ignored.
    ///
    /// # Panics
    /// If a capacity is negative.
    pub fn edge(&mut self, from: usize, to: usize, forward: i64, backward: i64) {
        assert!(forward >= 0 && backward >= 0, "capacities are not negative");
        if from != to && (forward > 0 || backward > 0) {
            self.edges.push((from as u32, to as u32, forward, backward));
        }
    }

    /// Adds to the cost of `node` being on the sink side and on the source side of the cut. Only
    /// the difference of the two matters.
    ///
    /// # Panics
    /// If the node does not exist.
    pub fn terminal(&mut self, node: usize, on_sink_side: i64, on_source_side: i64) {
        self.terminal[node] += on_sink_side - on_source_side;
    }

    /// Maximises the flow and returns, for each node `(n,)`, whether it is on the sink side of the
    /// minimum cut with the fewest nodes on the source side. A node without a connection to either
    /// side is on the sink side.
    ///
    /// ```
    /// use coseg_geometry::linalg::maxflow::Network;
    ///
    /// let mut network = Network::new(2);
    /// network.terminal(0, 1, 0); // on the sink side node 0 would cost 1
    /// assert_eq!(network.sink_side(), [false, true]);
    /// ```
    pub fn sink_side(self) -> Vec<bool> {
        let mut search = Search::new(&self);
        search.run();
        let in_source_tree = |node: &Node| node.parent != FREE && !node.sink;
        search.nodes.iter().map(|v| !in_source_tree(v)).collect()
    }
}

#[derive(Debug, Clone, Copy)]
struct Arc {
    head: u32,
    /// The arc back.
    back: u32,
    residual: i64,
}

#[derive(Debug, Clone, Copy)]
struct Node {
    /// The arc to the parent in its tree, or one of the three constants above.
    parent: u32,
    /// The time at which its distance was last known to be right, and that distance, in arcs from
    /// the root.
    seen: u32,
    distance: u32,
    /// The tree that contains the node, if any: true for the sink's.
    sink: bool,
    /// Whether it waits in `active`.
    waits: bool,
}

/// The state of the search. The trees grow from both ends until they touch. Arcs that a path
/// saturates are cut; the subtrees behind them are attached elsewhere or set free.
struct Search {
    nodes: Vec<Node>,
    /// Arcs of each node, in the order in which edges were added, and the index of each node's
    /// first arc.
    arcs: Vec<Arc>,
    first: Vec<u32>,
    terminal: Vec<i64>,
    active: VecDeque<u32>,
    orphans: VecDeque<u32>,
    /// Orphans of the last path, nearest to the roots first.
    cut_off: VecDeque<u32>,
    now: u32,
}

impl Search {
    fn new(network: &Network) -> Self {
        let n = network.terminal.len();
        let mut first = vec![0_u32; n + 1];
        for &(a, b, ..) in &network.edges {
            first[a as usize + 1] += 1;
            first[b as usize + 1] += 1;
        }
        for v in 0..n {
            first[v + 1] += first[v];
        }
        let mut next = first.clone();
        let nothing = Arc {
            head: 0,
            back: 0,
            residual: 0,
        };
        let mut arcs = vec![nothing; 2 * network.edges.len()];
        for &(a, b, forward, backward) in &network.edges {
            let (there, back) = (next[a as usize], next[b as usize]);
            next[a as usize] += 1;
            next[b as usize] += 1;
            arcs[there as usize] = Arc {
                head: b,
                back,
                residual: forward,
            };
            arcs[back as usize] = Arc {
                head: a,
                back: there,
                residual: backward,
            };
        }
        let node = |&terminal: &i64| Node {
            parent: if terminal == 0 { FREE } else { ROOT },
            seen: 0,
            distance: 1,
            sink: terminal < 0,
            waits: terminal != 0,
        };
        let nodes: Vec<Node> = network.terminal.iter().map(node).collect();
        let active = (0..n as u32).filter(|v| nodes[*v as usize].waits).collect();
        Self {
            nodes,
            arcs,
            first,
            terminal: network.terminal.clone(),
            active,
            orphans: VecDeque::new(),
            cut_off: VecDeque::new(),
            now: 0,
        }
    }

    fn arcs_of(&self, v: u32) -> std::ops::Range<usize> {
        self.first[v as usize] as usize..self.first[v as usize + 1] as usize
    }

    /// Capacity left along an arc away from the root of the tree of the arc's tail.
    fn away(&self, arc: usize, sink: bool) -> i64 {
        let arc = &self.arcs[arc];
        if sink {
            self.arcs[arc.back as usize].residual
        } else {
            arc.residual
        }
    }

    fn activate(&mut self, v: u32) {
        if !std::mem::replace(&mut self.nodes[v as usize].waits, true) {
            self.active.push_back(v);
        }
    }

    fn run(&mut self) {
        while let Some(v) = self.active.pop_front() {
            self.nodes[v as usize].waits = false;
            // The same node continues to grow as long as it is in a tree and touches the other
            // tree.
            while self.nodes[v as usize].parent != FREE {
                let Some(bridge) = self.grow(v) else { break };
                self.now += 1;
                self.augment(bridge);
                while let Some(orphan) = self.cut_off.pop_front() {
                    self.orphans.push_back(orphan);
                    while let Some(orphan) = self.orphans.pop_front() {
                        self.adopt(orphan);
                    }
                }
            }
        }
    }

    /// Adds the free neighbours of a node to its tree; returns an arc from the source's tree to the
    /// sink's if there is one.
    fn grow(&mut self, v: u32) -> Option<usize> {
        let me = self.nodes[v as usize];
        for a in self.arcs_of(v) {
            if self.away(a, me.sink) == 0 {
                continue;
            }
            let (w, back) = (self.arcs[a].head, self.arcs[a].back);
            let other = &mut self.nodes[w as usize];
            let closer = other.seen <= me.seen && other.distance > me.distance;
            if other.parent == FREE || (other.sink == me.sink && closer) {
                let was_free = other.parent == FREE;
                other.sink = me.sink;
                other.parent = back;
                other.seen = me.seen;
                other.distance = me.distance + 1;
                if was_free {
                    self.activate(w);
                }
            } else if other.sink != me.sink {
                return Some(if me.sink { back as usize } else { a });
            }
        }
        None
    }

    /// Augments the flow along the path through an arc between the trees.
    fn augment(&mut self, bridge: usize) {
        let Arc {
            head: sink_end,
            back,
            residual,
        } = self.arcs[bridge];
        let source_end = self.arcs[back as usize].head;
        let mut flow = residual;
        for (end, sink) in [(source_end, false), (sink_end, true)] {
            let mut v = end;
            while self.nodes[v as usize].parent != ROOT {
                let parent = self.arcs[self.nodes[v as usize].parent as usize];
                flow = flow.min(if sink {
                    parent.residual
                } else {
                    self.arcs[parent.back as usize].residual
                });
                v = parent.head;
            }
            flow = flow.min(self.terminal[v as usize].abs());
        }
        self.arcs[bridge].residual -= flow;
        self.arcs[back as usize].residual += flow;
        for (end, sink) in [(source_end, false), (sink_end, true)] {
            let mut v = end;
            while self.nodes[v as usize].parent != ROOT {
                let up = self.nodes[v as usize].parent as usize;
                let (head, down) = (self.arcs[up].head, self.arcs[up].back as usize);
                let (gives, takes) = if sink { (up, down) } else { (down, up) };
                self.arcs[gives].residual -= flow;
                self.arcs[takes].residual += flow;
                if self.arcs[gives].residual == 0 {
                    self.nodes[v as usize].parent = ORPHAN;
                    self.cut_off.push_front(v);
                }
                v = head;
            }
            self.terminal[v as usize] += if sink { flow } else { -flow };
            if self.terminal[v as usize] == 0 {
                self.nodes[v as usize].parent = ORPHAN;
                self.cut_off.push_front(v);
            }
        }
    }

    /// Number of arcs from a node to its root, or `None` if the path ends at an orphan. Stores the
    /// distances along the path.
    fn distance_to_root(&mut self, from: u32) -> Option<u32> {
        let mut v = from;
        let mut steps = 0;
        let distance = loop {
            let node = &mut self.nodes[v as usize];
            if node.seen == self.now {
                break steps + node.distance;
            }
            match node.parent {
                ORPHAN | FREE => return None,
                ROOT => {
                    (node.seen, node.distance) = (self.now, 1);
                    break steps + 1;
                }
                arc => {
                    v = self.arcs[arc as usize].head;
                    steps += 1;
                }
            }
        };
        let mut v = from;
        let mut left = distance;
        while self.nodes[v as usize].seen != self.now {
            (self.nodes[v as usize].seen, self.nodes[v as usize].distance) = (self.now, left);
            left -= 1;
            v = self.arcs[self.nodes[v as usize].parent as usize].head;
        }
        Some(distance)
    }

    /// Attaches an orphan to the neighbour nearest to the root, or frees it together with its
    /// subtree.
    fn adopt(&mut self, v: u32) {
        let sink = self.nodes[v as usize].sink;
        let mut best: Option<(u32, usize)> = None;
        for a in self.arcs_of(v) {
            let Arc { head, back, .. } = self.arcs[a];
            // The arc from the neighbour to this node, away from the root.
            if self.away(back as usize, sink) == 0 {
                continue;
            }
            let other = self.nodes[head as usize];
            if other.sink != sink || other.parent == FREE {
                continue;
            }
            if let Some(distance) = self.distance_to_root(head)
                && best.is_none_or(|(least, _)| distance < least)
            {
                best = Some((distance, a));
            }
        }
        if let Some((distance, a)) = best {
            let node = &mut self.nodes[v as usize];
            node.parent = a as u32;
            (node.seen, node.distance) = (self.now, distance + 1);
            return;
        }
        self.nodes[v as usize].parent = FREE;
        for a in self.arcs_of(v) {
            let Arc { head, back, .. } = self.arcs[a];
            let other = self.nodes[head as usize];
            if other.sink != sink || other.parent == FREE {
                continue;
            }
            if self.away(back as usize, sink) > 0 {
                self.activate(head);
            }
            if other.parent < ORPHAN && self.arcs[other.parent as usize].head == v {
                self.nodes[head as usize].parent = ORPHAN;
                self.orphans.push_back(head);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};

    /// Cost of a labelling: terminals plus cut edges.
    fn cost(side: &[bool], terminals: &[(i64, i64)], edges: &[(usize, usize, i64, i64)]) -> i64 {
        let mut total = 0;
        for (v, &(on_sink, on_source)) in terminals.iter().enumerate() {
            total += if side[v] { on_sink } else { on_source };
        }
        for &(a, b, forward, backward) in edges {
            total += if !side[a] && side[b] { forward } else { 0 };
            total += if side[a] && !side[b] { backward } else { 0 };
        }
        total
    }

    fn network(terminals: &[(i64, i64)], edges: &[(usize, usize, i64, i64)]) -> Network {
        let mut network = Network::new(terminals.len());
        for (v, &(on_sink, on_source)) in terminals.iter().enumerate() {
            network.terminal(v, on_sink, on_source);
        }
        for &(a, b, f, w) in edges {
            network.edge(a, b, f, w);
        }
        network
    }

    #[test]
    fn the_cut_is_the_minimal_one_with_the_fewest_sources_on_every_small_graph() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(3);
        for round in 0..300 {
            let n = rng.random_range(1..=9usize);
            // Few values, so that many cuts cost the same.
            let most = if round % 2 == 0 { 20 } else { 4 };
            let terminals: Vec<_> = (0..n)
                .map(|_| (rng.random_range(0..most), rng.random_range(0..most)))
                .collect();
            let edges: Vec<_> = (0..2 * n)
                .map(|_| {
                    let (a, b) = (rng.random_range(0..n), rng.random_range(0..n));
                    (a, b, rng.random_range(0..most), rng.random_range(0..most))
                })
                .filter(|e| e.0 != e.1)
                .collect();
            let side = network(&terminals, &edges).sink_side();
            let least = (0..1usize << n)
                .map(|m| {
                    let side: Vec<bool> = (0..n).map(|v| m >> v & 1 == 1).collect();
                    let sources = side.iter().filter(|s| !**s).count();
                    (cost(&side, &terminals, &edges), sources)
                })
                .min();
            let sources = side.iter().filter(|s| !**s).count();
            let found = (cost(&side, &terminals, &edges), sources);
            assert_eq!(Some(found), least, "round {round}");
        }
    }

    /// Nodes that the source does not reach after augmenting along shortest paths until none is
    /// left.
    fn slowly(terminals: &[(i64, i64)], edges: &[(usize, usize, i64, i64)]) -> Vec<bool> {
        let n = terminals.len();
        let (s, t) = (n, n + 1);
        let mut around: Vec<Vec<usize>> = vec![Vec::new(); n + 2];
        let mut arcs: Vec<(usize, i64)> = Vec::new();
        let ends = (terminals.iter().enumerate())
            .flat_map(|(v, &(x, y))| [(s, v, x, 0), (v, t, y, 0)])
            .chain(edges.iter().copied());
        for (a, b, there, back) in ends {
            around[a].push(arcs.len());
            arcs.push((b, there));
            around[b].push(arcs.len());
            arcs.push((a, back));
        }
        loop {
            let mut by = vec![None; n + 2];
            let mut queue = VecDeque::from([s]);
            while let Some(v) = queue.pop_front() {
                for &a in &around[v] {
                    let (w, left) = arcs[a];
                    if left > 0 && w != s && by[w].is_none() {
                        by[w] = Some(a);
                        queue.push_back(w);
                    }
                }
            }
            if by[t].is_none() {
                return (0..n).map(|v| by[v].is_none()).collect();
            }
            let mut path = Vec::new();
            let mut v = t;
            while let Some(a) = by[v] {
                path.push(a);
                v = arcs[a ^ 1].0;
            }
            let flow = path.iter().map(|a| arcs[*a].1).min().unwrap();
            for a in path {
                arcs[a].1 -= flow;
                arcs[a ^ 1].1 += flow;
            }
        }
    }

    #[test]
    fn larger_grids_are_cut_as_by_shortest_paths() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(5);
        for round in 0..12 {
            let n = 24;
            let most = if round % 2 == 0 { 1_000_000 } else { 5 };
            let terminals: Vec<_> = (0..n * n)
                .map(|_| match rng.random_range(0..6) {
                    0 => (rng.random_range(0..3 * most), 0),
                    1 => (0, rng.random_range(0..3 * most)),
                    _ => (0, 0),
                })
                .collect();
            let mut edges = Vec::new();
            for y in 0..n {
                for x in 0..n {
                    let v = y * n + x;
                    let right = (x + 1 < n).then_some(v + 1);
                    let below = (y + 1 < n).then_some(v + n);
                    for w in right.into_iter().chain(below) {
                        edges.push((v, w, rng.random_range(0..most), rng.random_range(0..most)));
                    }
                }
            }
            let found = network(&terminals, &edges).sink_side();
            assert!(found == slowly(&terminals, &edges), "round {round}");
        }
    }
}
