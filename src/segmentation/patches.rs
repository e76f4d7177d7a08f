//! temp
#![allow(missing_docs, clippy::all)]
use crate::mesh::*;
pub fn patches(mesh: &TriMesh, dual: &DualGraph, start: u32, n: usize) -> Vec<u32> {
    let g = FaceGeometry::new(mesh); let m = g.areas.len(); let mut adj = vec![vec![]; m];
    for e in &dual.edges { let [a, b] = e.faces; let eta = if e.convex { 0.15 } else { 1.0 }; let c = (e.distance + 1e-6) * (1.0 + 4.0 * eta * e.angle); adj[a as usize].push((b as usize, c)); adj[b as usize].push((a as usize, c)); }
    let dj = |s: &[usize]| -> (Vec<f64>, Vec<u32>) { let mut d = vec![f64::INFINITY; m]; let mut o = vec![0u32; m]; let mut h = std::collections::BinaryHeap::new(); for (i, x) in s.iter().enumerate() { d[*x] = 0.0; o[*x] = i as u32; h.push((std::cmp::Reverse(0u64), *x)); }
        while let Some((std::cmp::Reverse(b), f)) = h.pop() { let x = f64::from_bits(b); if x > d[f] { continue; } for &(q, c) in &adj[f] { if x + c < d[q] { d[q] = x + c; o[q] = o[f]; h.push((std::cmp::Reverse((x + c).to_bits()), q)); } } } (d, o) };
    let far = |d: &[f64]| (0..m).max_by(|a, b| d[*a].total_cmp(&d[*b])).unwrap();
    let mut seeds = vec![far(&dj(&[start as usize]).0)]; while seeds.len() < n.min(m) { seeds.push(far(&dj(&seeds).0)); }
    let mut own = dj(&seeds).1;
    for _ in 0..2 { let mut c = vec![[0.0; 4]; seeds.len()]; for f in 0..m { let o = own[f] as usize; for k in 0..3 { c[o][k] += g.areas[f] * g.centroids[f][k]; } c[o][3] += g.areas[f]; }
        let mut best = vec![(f64::INFINITY, 0usize); seeds.len()]; for f in 0..m { let o = own[f] as usize; let d: f64 = (0..3).map(|k| (g.centroids[f][k] - c[o][k] / c[o][3].max(1e-300)).powi(2)).sum(); if d < best[o].0 { best[o] = (d, f); } } for (s, b) in seeds.iter_mut().zip(&best) { if b.0.is_finite() { *s = b.1; } } own = dj(&seeds).1; }
    let mut id = std::collections::HashMap::new(); own.iter().map(|o| { let k = id.len() as u32; *id.entry(*o).or_insert(k) }).collect()
}
