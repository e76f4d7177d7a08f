//! temp
#![allow(missing_docs, clippy::all)]
use crate::mesh::*;
use nalgebra::{DMatrix, Matrix3, SymmetricEigen, Vector3};
pub const GROUPS: &[(&str, usize)] = &[("sdf", 2), ("agd", 3), ("gc", 7), ("q", 6), ("pc", 15), ("pos", 7), ("hks", 16), ("hksn", 16), ("wks", 20)];
pub struct FaceDescriptors { pub data: Vec<f32>, pub n: usize, pub farthest_start: u32 }
pub fn hks_times(v: &[f64], n: usize) -> Vec<f64> {
    let last = v[v.len() - 1]; let l2 = v.iter().copied().find(|x| *x > 1e-9 * last).unwrap_or(last);
    let (a, b) = (4.0 * 10f64.ln() / last, 4.0 * 10f64.ln() / l2);
    (0..n).map(|j| a * (b / a).powf(j as f64 / (n - 1) as f64)).collect()
}
pub fn hks(v: &[f64], e: &DMatrix<f64>, t: &[f64]) -> Vec<f32> {
    let sq = e.map(|x| x * x); let w = DMatrix::from_fn(v.len(), t.len(), |i, j| (-v[i] * t[j]).exp());
    let h = sq * w; let mut out = vec![0f32; h.nrows() * h.ncols()];
    for i in 0..h.nrows() { for j in 0..h.ncols() { out[i * h.ncols() + j] = h[(i, j)] as f32; } } out
}
fn smooth(dual: &DualGraph, x: &mut Vec<f64>, dim: usize, rounds: usize) {
    let m = dual.n_faces();
    let mut adj = vec![vec![]; m]; for e in &dual.edges { let [a, b] = e.faces; adj[a as usize].push(b as usize); adj[b as usize].push(a as usize); }
    for _ in 0..rounds { let old = x.clone(); for f in 0..m { if adj[f].is_empty() { continue; } for c in 0..dim { let s: f64 = adj[f].iter().map(|g| old[g * dim + c]).sum::<f64>() / adj[f].len() as f64; x[f * dim + c] = 0.5 * old[f * dim + c] + 0.5 * s; } } }
}
pub fn up_columns(mesh: &TriMesh, axis: [f64; 3]) -> Vec<[f32; 3]> {
    let g = FaceGeometry::new(mesh); let b = bridges(mesh); let dual = DualGraph::new(mesh, &b);
    let m = g.areas.len(); let d = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let h: Vec<f64> = g.centroids.iter().map(|c| d(*c, axis)).collect();
    let (lo, hi) = h.iter().fold((f64::MAX, f64::MIN), |a, x| (a.0.min(*x), a.1.max(*x)));
    let tot: f64 = g.areas.iter().sum(); let mut c0 = [0.0; 3];
    for f in 0..m { for k in 0..3 { c0[k] += g.areas[f] * g.centroids[f][k] / tot; } }
    let r: Vec<f64> = g.centroids.iter().map(|c| { let x = [c[0] - c0[0], c[1] - c0[1], c[2] - c0[2]]; let u = d(x, axis); (d(x, x) - u * u).max(0.0).sqrt() }).collect();
    let rm = r.iter().fold(0.0f64, |a, x| a.max(*x));
    let mut x: Vec<f64> = (0..m).flat_map(|f| [(h[f] - lo) / (hi - lo + 1e-9), r[f] / (rm + 1e-9), d(g.normals[f], axis)]).collect();
    smooth(&dual, &mut x, 3, 2);
    x.chunks(3).map(|c| [c[0] as f32, c[1] as f32, c[2] as f32]).collect()
}
fn eig(c: Matrix3<f64>) -> ([f64; 3], [Vector3<f64>; 3]) { let s = SymmetricEigen::new(c); let mut o = [0, 1, 2]; o.sort_by(|a, b| s.eigenvalues[*b].total_cmp(&s.eigenvalues[*a])); (o.map(|i| s.eigenvalues[i].max(1e-12)), o.map(|i| s.eigenvectors.column(i).into_owned())) }
fn rank(x: &[f64], a: &[f64]) -> Vec<f64> { let mut o: Vec<usize> = (0..x.len()).collect(); o.sort_by(|p, q| x[*p].total_cmp(&x[*q])); let t: f64 = a.iter().sum(); let mut r = vec![0.0; x.len()]; let mut c = 0.0; for i in o { r[i] = (c + 0.5 * a[i]) / t; c += a[i]; } r }
pub fn face_descriptors(mesh: &TriMesh, br: &[Bridge], dual: &DualGraph, v: &[f64], e: &DMatrix<f64>) -> FaceDescriptors {
    let g = FaceGeometry::new(mesh); let m = g.areas.len(); let nv = mesh.vertices.len(); let a = &g.areas;
    let graph = EdgeGraph::new(mesh, br);
    let mut va = vec![0.0; nv]; for f in 0..m { for q in mesh.faces[f] { va[q as usize] += a[f] / 3.0; } }
    // geodesics
    let ns = 60.min(nv); let first = graph.dijkstra(0); let mut cur = vec![f64::INFINITY; nv]; let mut src = (0..nv).max_by(|x, y| first[*x].total_cmp(&first[*y])).unwrap();
    let mut d: Vec<Vec<f64>> = vec![]; for _ in 0..ns { let x = graph.dijkstra(src as u32); for i in 0..nv { cur[i] = cur[i].min(x[i]); } d.push(x); src = (0..nv).max_by(|x, y| cur[*x].total_cmp(&cur[*y])).unwrap(); }
    let mut ws = vec![0.0; ns]; for i in 0..nv { let o = (0..ns).min_by(|x, y| d[*x][i].total_cmp(&d[*y][i])).unwrap(); ws[o] += va[i]; } let t: f64 = ws.iter().sum(); ws.iter_mut().for_each(|w| *w /= t);
    let mut mx: Vec<f64> = (0..nv).map(|i| (0..ns).map(|s| d[s][i]).fold(0.0, f64::max)).collect(); mx.sort_by(f64::total_cmp); let gmax = mx[nv / 2];
    let mut vagd = vec![0.0; nv]; let mut vq = vec![[0.0; 6]; nv]; let mut vgc = vec![[0.0; 7]; nv];
    for i in 0..nv { let mut s: Vec<f64> = (0..ns).map(|k| d[k][i]).collect(); vagd[i] = s.iter().zip(&ws).map(|(x, w)| x * w).sum();
        for (j, q) in (1..8).enumerate() { let b = 1.5 * q as f64 / 8.0; vgc[i][j] = (0..ns).filter(|k| d[*k][i] / gmax <= b).map(|k| ws[k]).sum(); }
        s.sort_by(f64::total_cmp); for (j, q) in [0.1, 0.25, 0.5, 0.75, 0.9, 1.0].iter().enumerate() { let p = q * (ns - 1) as f64; let lo = p.floor() as usize; let hi = (lo + 1).min(ns - 1); vq[i][j] = s[lo] + (p - lo as f64) * (s[hi] - s[lo]); } }
    let tof = |x: &dyn Fn(usize) -> f64| -> Vec<f64> { mesh.faces.iter().map(|f| f.iter().map(|q| x(*q as usize)).sum::<f64>() / 3.0).collect() };
    // sdf
    let bvh = Bvh::new(mesh); let nr = 30; let mut sdf = vec![f64::NAN; m];
    let loc: Vec<([f64; 3], f64)> = (0..nr).map(|i| { let u = (i as f64 + 0.5) / nr as f64; let th = (1.0 - u * (1.0 - 60f64.to_radians().cos())).acos(); let ph = i as f64 * 2.399963; ([th.sin() * ph.cos(), th.sin() * ph.sin(), th.cos()], th) }).collect();
    for f in 0..m { let n = Vector3::from(g.normals[f]) * -1.0; let ax = if n[0].abs() > 0.9 { Vector3::y() } else { Vector3::x() }; let tt = n.cross(&ax).normalize(); let b = n.cross(&tt); let o = Vector3::from(g.centroids[f]) + n * 1e-4;
        let mut ds: Vec<(f64, f64)> = loc.iter().filter_map(|(l, th)| { let dir = tt * l[0] + b * l[1] + n * l[2]; bvh.cast(o.into(), dir.into(), f as u32).map(|x| (x, *th)) }).collect();
        if ds.is_empty() { continue; } ds.sort_by(|x, y| x.0.total_cmp(&y.0)); let med = if ds.len() % 2 == 1 { ds[ds.len() / 2].0 } else { 0.5 * (ds[ds.len() / 2].0 + ds[ds.len() / 2 - 1].0) }; let mean = ds.iter().map(|x| x.0).sum::<f64>() / ds.len() as f64; let sd = (ds.iter().map(|x| (x.0 - mean).powi(2)).sum::<f64>() / ds.len() as f64).sqrt();
        let (mut s, mut w) = (0.0, 0.0); for (x, th) in ds { if (x - med).abs() <= 1.5 * sd + 1e-9 { let q = 1.0 / (th + 0.2); s += q * x; w += q; } } if w > 1e-9 { sdf[f] = s / w; } }
    let mut ok: Vec<f64> = sdf.iter().copied().filter(|x| x.is_finite()).collect(); ok.sort_by(f64::total_cmp); let med = ok.get(ok.len() / 2).copied().unwrap_or(0.1); for x in &mut sdf { if !x.is_finite() { *x = med; } }
    smooth(dual, &mut sdf, 1, 3);
    let ls: Vec<f64> = sdf.iter().map(|x| x.max(1e-4).ln()).collect(); let rs = rank(&ls, a);
    let agd = tof(&|i| vagd[i]); let ra = rank(&agd, a); let mut sa = agd.clone(); sa.sort_by(f64::total_cmp); let pc = |p: f64| { let x = p * (m - 1) as f64; let l = x.floor() as usize; sa[l] + (x - l as f64) * (sa[(l + 1).min(m - 1)] - sa[l]) }; let (p1, p99) = (pc(0.01), pc(0.99)); let mn = sa[0];
    let q: Vec<Vec<f64>> = (0..6).map(|j| tof(&|i| vq[i][j])).collect(); let q5: f64 = (0..m).map(|f| a[f] * q[5][f]).sum::<f64>() / a.iter().sum::<f64>();
    let gc: Vec<Vec<f64>> = (0..7).map(|j| tof(&|i| vgc[i][j])).collect();
    // local PCA
    let mut pcs = vec![vec![]; m];
    for r in [0.05f64, 0.1, 0.2] { let key = |c: [f64; 3]| [(c[0] / r).floor() as i64, (c[1] / r).floor() as i64, (c[2] / r).floor() as i64]; let mut grid: std::collections::HashMap<[i64; 3], Vec<u32>> = Default::default(); for f in 0..m { grid.entry(key(g.centroids[f])).or_default().push(f as u32); }
        for f in 0..m { let k = key(g.centroids[f]); let mut nb = vec![]; for x in -1..2 { for y in -1..2 { for z in -1..2 { if let Some(l) = grid.get(&[k[0] + x, k[1] + y, k[2] + z]) { for &h in l { let p = g.centroids[h as usize]; let q = g.centroids[f]; if (p[0] - q[0]).powi(2) + (p[1] - q[1]).powi(2) + (p[2] - q[2]).powi(2) <= r * r { nb.push(h as usize); } } } } } }
            let w: f64 = nb.iter().map(|h| a[*h]).sum(); let mut c = Vector3::zeros(); for h in &nb { c += a[*h] / w * Vector3::from(g.centroids[*h]); } let mut cov = Matrix3::zeros(); for h in &nb { let x = Vector3::from(g.centroids[*h]) - c; cov += a[*h] / w * x * x.transpose(); } let (ev, vec) = eig(cov);
            pcs[f].extend([(ev[0] - ev[1]) / ev[0], (ev[1] - ev[2]) / ev[0], ev[2] / ev[0], w / (std::f64::consts::PI * r * r), Vector3::from(g.normals[f]).dot(&vec[0]).abs()]); } }
    // position
    let ta: f64 = a.iter().sum(); let mut c = Vector3::zeros(); for f in 0..m { c += a[f] / ta * Vector3::from(g.centroids[f]); } let mut cov = Matrix3::zeros(); for f in 0..m { let x = Vector3::from(g.centroids[f]) - c; cov += a[f] * x * x.transpose(); } let (_, ax) = eig(cov);
    // spectral
    let kk = v.len().min(100); let w = &v[..kk]; let last = w[kk - 1]; let l2 = w.iter().copied().find(|x| *x > 1e-9 * last).unwrap_or(last).max(1e-3);
    let ts: Vec<f64> = (0..16).map(|j| 4.0 * 10f64.ln() / last * (last / l2).powf(j as f64 / 15.0)).collect();
    let e2 = e.columns(0, kk).map(|x| x * x); let mut wt = DMatrix::from_fn(kk, 16, |i, j| (-w[i] * ts[j]).exp()); for mut col in wt.column_iter_mut() { let s = col.sum(); col /= s; } let hv = &e2 * wt;
    let le: Vec<f64> = w[1..].iter().map(|x| x.max(1e-6).ln()).collect(); let (e0, e1) = (le[0], le[kk - 2]); let sig = 7.0 * (e1 - e0) / 100.0;
    let mut ww = DMatrix::from_fn(kk, 20, |i, j| if i == 0 { 0.0 } else { let en = e0 + (e1 - e0) * j as f64 / 19.0; (-(en - le[i - 1]).powi(2) / (2.0 * sig * sig + 1e-12)).exp() }); for mut col in ww.column_iter_mut() { let s = col.sum().max(1e-12); col /= s; } let wv = &e2 * ww;
    let hf: Vec<Vec<f64>> = (0..16).map(|j| tof(&|i| hv[(i, j)]).iter().map(|x| x.max(1e-6).ln()).collect()).collect();
    let wf: Vec<Vec<f64>> = (0..20).map(|j| tof(&|i| wv[(i, j)]).iter().map(|x| x.max(1e-6).ln()).collect()).collect();
    let hm: Vec<f64> = hf.iter().map(|h| (0..m).map(|f| a[f] * h[f]).sum::<f64>() / ta).collect();
    let mut x = Vec::with_capacity(m * 92);
    for f in 0..m { x.extend([ls[f], 2.0 * rs[f], (agd[f] - p1) / (p99 - p1 + 1e-9), 3.0 * ra[f] , agd[f] / mn - 1.0]); x.extend(gc.iter().map(|c| c[f])); x.extend(q.iter().map(|c| c[f] / q5)); x.extend(&pcs[f]);
        let p = Vector3::from(g.centroids[f]) - c; let n = Vector3::from(g.normals[f]); x.extend(ax.iter().map(|u| u.dot(&p).abs())); x.push(p.norm()); x.extend(ax.iter().map(|u| u.dot(&n).abs()));
        x.extend(hf.iter().map(|h| h[f])); x.extend(hf.iter().zip(&hm).map(|(h, mu)| h[f] - mu)); x.extend(wf.iter().map(|h| h[f])); }
    smooth(dual, &mut x, 92, 2);
    let farthest_start = (0..m).max_by(|p, q| agd[*p].total_cmp(&agd[*q])).unwrap_or(0) as u32;
    FaceDescriptors { data: x.iter().map(|v| *v as f32).collect(), n: 92, farthest_start }
}
pub fn signature(mesh: &TriMesh, face: &FaceDescriptors, _v: &[f64]) -> Vec<f32> {
    let a = FaceGeometry::new(mesh).areas; let m = a.len(); let n = face.n; let ta: f64 = a.iter().sum(); let mut out = vec![0f32; 4 * n];
    for c in 0..n { let mut x: Vec<(f32, f64)> = (0..m).map(|f| (face.data[f * n + c], a[f])).collect(); out[c] = (x.iter().map(|p| p.0 as f64 * p.1).sum::<f64>() / ta) as f32; x.sort_by(|p, q| p.0.total_cmp(&q.0)); for (k, q) in [0.1, 0.5, 0.9].iter().enumerate() { let mut s = 0.0; for p in &x { s += p.1; if s >= q * ta { out[(k + 1) * n + c] = p.0; break; } } } }
    out
}
