//! Minimum cuts of sparse graphs by Dinic's algorithm, with integer capacities (exact and deterministic).

use std::collections::VecDeque;

/// A flow network over `n` nodes with a source and a sink of its own.
#[derive(Debug, Clone)]
pub struct Network {
    /// Residual capacity of each arc; arc `2e` and `2e + 1` are each other's reverse.
    residual: Vec<i64>,
    head: Vec<u32>,
    first: Vec<u32>,
    next: Vec<u32>,
    n: usize,
}

const NONE: u32 = u32::MAX;

impl Network {
    /// A network of `n` nodes and no arcs.
    pub fn new(n: usize) -> Self {
        Self {
            residual: Vec::new(),
            head: Vec::new(),
            first: vec![NONE; n + 2],
            next: Vec::new(),
            n,
        }
    }

    fn source(&self) -> usize {
        self.n
    }

    fn sink(&self) -> usize {
        self.n + 1
    }

    fn add(&mut self, from: usize, to: usize, forward: i64, backward: i64) {
        assert!(forward >= 0 && backward >= 0, "capacities are not negative");
        for (a, b, c) in [(from, to, forward), (to, from, backward)] {
            self.next.push(self.first[a]);
            self.first[a] = self.head.len() as u32;
            self.head.push(b as u32);
            self.residual.push(c);
        }
    }

    /// Arcs `from → to` and `to → from` with the given capacities.
    pub fn edge(&mut self, from: usize, to: usize, forward: i64, backward: i64) {
        if forward > 0 || backward > 0 {
            self.add(from, to, forward, backward);
        }
    }

    /// The cost of `node` being on the sink side and on the source side of the cut.
    pub fn terminal(&mut self, node: usize, on_sink_side: i64, on_source_side: i64) {
        let common = on_sink_side.min(on_source_side);
        let (s, t) = (self.source(), self.sink());
        if on_sink_side > common {
            self.add(s, node, on_sink_side - common, 0);
        } else if on_source_side > common {
            self.add(node, t, on_source_side - common, 0);
        }
    }

    /// Maximises the flow and returns, for each node, whether it is on the sink side of the minimum
    /// cut that has the fewest nodes on the source side.
    pub fn sink_side(mut self) -> Vec<bool> {
        let (s, t) = (self.source(), self.sink());
        let mut level = vec![NONE; self.n + 2];
        while self.levels(&mut level) {
            self.block(s, t, &level);
        }
        (0..self.n).map(|v| level[v] == NONE).collect()
    }

    /// Breadth-first levels from the source over residual arcs; whether the sink is reached.
    fn levels(&self, level: &mut [u32]) -> bool {
        level.fill(NONE);
        level[self.source()] = 0;
        let mut queue = VecDeque::from([self.source()]);
        while let Some(v) = queue.pop_front() {
            let mut a = self.first[v];
            while a != NONE {
                let (w, c) = (self.head[a as usize] as usize, self.residual[a as usize]);
                if c > 0 && level[w] == NONE {
                    level[w] = level[v] + 1;
                    queue.push_back(w);
                }
                a = self.next[a as usize];
            }
        }
        level[self.sink()] != NONE
    }

    /// Sends flow along paths of the level graph until none is left, without recursion. After a path is
    /// used, the search goes on from where it first became full.
    fn block(&mut self, s: usize, t: usize, level: &[u32]) {
        let mut arc = self.first.clone();
        let mut path: Vec<u32> = Vec::new();
        let mut v = s;
        loop {
            if v == t {
                let residual = &self.residual;
                let flow = path.iter().map(|a| residual[*a as usize]).min();
                let flow = flow.expect("invariant: source and sink differ");
                for &a in &path {
                    self.residual[a as usize] -= flow;
                    self.residual[a as usize ^ 1] += flow;
                }
                let full = path.iter().position(|a| self.residual[*a as usize] == 0);
                let full = full.expect("invariant: the least residual is used up");
                v = self.head[path[full] as usize ^ 1] as usize;
                path.truncate(full);
                continue;
            }
            let a = arc[v];
            if a == NONE {
                let Some(back) = path.pop() else { return };
                v = self.head[back as usize ^ 1] as usize;
                arc[v] = self.next[arc[v] as usize];
                continue;
            }
            let w = self.head[a as usize] as usize;
            if self.residual[a as usize] > 0 && level[w] == level[v].wrapping_add(1) {
                path.push(a);
                v = w;
            } else {
                arc[v] = self.next[a as usize];
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

    #[test]
    fn the_cut_is_minimal_on_every_small_graph() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(3);
        for round in 0..300 {
            let n = rng.random_range(1..=9usize);
            let terminals: Vec<_> = (0..n)
                .map(|_| (rng.random_range(0..20i64), rng.random_range(0..20i64)))
                .collect();
            let edges: Vec<_> = (0..2 * n)
                .map(|_| {
                    let (a, b) = (rng.random_range(0..n), rng.random_range(0..n));
                    (a, b, rng.random_range(0..12i64), rng.random_range(0..12i64))
                })
                .filter(|e| e.0 != e.1)
                .collect();
            let mut network = Network::new(n);
            for (v, &(on_sink, on_source)) in terminals.iter().enumerate() {
                network.terminal(v, on_sink, on_source);
            }
            for &(a, b, f, w) in &edges {
                network.edge(a, b, f, w);
            }
            let found = cost(&network.sink_side(), &terminals, &edges);
            let least = (0..1usize << n)
                .map(|m| {
                    cost(
                        &(0..n).map(|v| m >> v & 1 == 1).collect::<Vec<_>>(),
                        &terminals,
                        &edges,
                    )
                })
                .min();
            assert_eq!(Some(found), least, "round {round}");
        }
    }
}
