//! The embedded body is a closed, well-formed, plausible human.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::sync::LazyLock;

use glam::Vec3;
use smpl::{BodyModel, Placement};

static BODY: LazyLock<BodyModel> = LazyLock::new(BodyModel::embedded);

fn mesh(vertices: Vec<Vec3>) -> testkit::TriMesh {
    testkit::TriMesh { vertices, faces: BODY.faces.clone() }
}

#[test]
fn it_is_valid_and_has_the_promised_size() {
    BODY.validate("embedded").unwrap();
    assert_eq!((BODY.num_joints(), BODY.num_betas()), (24, 10));
    assert_eq!((BODY.num_vertices(), BODY.faces.len()), (6890, 13776));
    let (low, high) = BODY.v_template.iter().fold((Vec3::MAX, Vec3::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
    let size = high - low;
    assert!((1.6..1.8).contains(&size.y) && (1.6..1.8).contains(&size.x), "{size}");
}

#[test]
fn it_is_closed_and_has_no_handles() {
    assert!(mesh(BODY.v_template.clone()).is_closed());
    let v = BODY.num_vertices() as i64;
    let f = BODY.faces.len() as i64;
    assert_eq!(v - f * 3 / 2 + f, 2, "Euler characteristic of a sphere");
    assert_eq!(BODY.faces.iter().flatten().collect::<HashSet<_>>().len() as i64, v, "a stray vertex");
    // The faces around every vertex form one fan: walking over them from edge to edge meets them
    // all.
    let mut next: HashMap<(u32, u32), u32> = HashMap::new();
    let mut count = vec![0; v as usize];
    for face in &BODY.faces {
        for i in 0..3 {
            next.insert((face[i], face[(i + 1) % 3]), face[(i + 2) % 3]);
            count[face[i] as usize] += 1;
        }
    }
    for face in &BODY.faces {
        let (centre, start) = (face[0], face[1]);
        let (mut at, mut steps) = (next[&(centre, start)], 1);
        while at != start {
            at = next[&(centre, at)];
            steps += 1;
        }
        assert_eq!(steps, count[centre as usize], "vertex {centre} joins two sheets");
    }
}

#[test]
fn it_has_the_volume_of_a_person() {
    let litres = 1e3 * mesh(BODY.v_template.clone()).volume();
    println!("{litres:.1} l");
    assert!((50.0..75.0).contains(&litres), "{litres}");
}

#[test]
fn it_is_mirror_symmetric() {
    let key = |v: Vec3| v.to_array().map(|x| (x * 1e6).round() as i64);
    let points: HashSet<[i64; 3]> = BODY.v_template.iter().map(|&v| key(v)).collect();
    for &v in &BODY.v_template {
        assert!(points.contains(&key(Vec3::new(-v.x, v.y, v.z))), "{v}");
    }
    let joints = BODY.shaped(&[]).joints;
    for (left, right) in [(1, 2), (4, 5), (7, 8), (10, 11), (13, 14), (16, 17), (18, 19), (20, 21), (22, 23)] {
        let mirrored = Vec3::new(-joints[right].x, joints[right].y, joints[right].z);
        assert!(joints[left].distance(mirrored) < 2e-4, "joints {left} and {right}");
        assert!(joints[left].x > 0.01, "left is at +x");
    }
}

#[test]
fn its_triangles_are_even() {
    let mut lengths: Vec<f32> = Vec::new();
    let mut worst = f32::INFINITY;
    for face in &BODY.faces {
        let p = face.map(|i| BODY.v_template[i as usize]);
        let edges = [0, 1, 2].map(|i| p[i].distance(p[(i + 1) % 3]));
        lengths.extend(edges);
        let area = 0.5 * (p[1] - p[0]).cross(p[2] - p[0]).length();
        // 1 for an equilateral triangle, 0 for a sliver.
        let quality = 4.0 * 3f32.sqrt() * area / edges.iter().map(|e| e * e).sum::<f32>();
        worst = worst.min(quality);
    }
    lengths.sort_by(f32::total_cmp);
    let (least, median, most) = (lengths[0], lengths[lengths.len() / 2], lengths[lengths.len() - 1]);
    println!("edges {least} {median} {most}, worst triangle {worst}");
    assert!(most < 0.07 && median > 0.01 && worst > 0.1, "{least} {median} {most} {worst}");
}

#[test]
fn its_joints_lie_inside_it_and_are_regressed_from_around_them() {
    let joints = BODY.shaped(&[]).joints;
    for (i, &joint) in joints.iter().enumerate() {
        assert!(testkit::oracle::inside(&BODY.v_template, &BODY.faces, joint), "joint {i} at {joint}");
        assert!(BODY.j_regressor.row(i).all(|(_, w)| w >= 0.0));
        let reach = BODY.j_regressor.row(i).map(|(v, _)| BODY.v_template[v].distance(joint)).fold(0.0, f32::max);
        assert!(reach < 0.21, "joint {i} depends on a vertex {reach} m away");
    }
}

#[test]
fn its_weights_are_sparse_smooth_and_sum_to_one() {
    for v in 0..BODY.num_vertices() {
        let row: BTreeMap<usize, f32> = BODY.weights.row(v).collect();
        assert!((1..=4).contains(&row.len()));
        assert!((row.values().sum::<f32>() - 1.0).abs() < 1e-6);
        assert!(row.values().all(|&w| w > 0.0));
    }
    let dense = |v: u32| {
        let mut row = [0.0f32; 24];
        BODY.weights.row(v as usize).for_each(|(j, w)| row[j] = w);
        row
    };
    let mut largest = 0.0f32;
    for face in &BODY.faces {
        let (a, b) = (dense(face[0]), dense(face[1]));
        let difference: f32 = a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum();
        largest = largest.max(0.5 * difference);
    }
    println!("largest step of weights along an edge {largest}");
    assert!(largest < 0.45, "{largest}");
}

#[test]
fn every_bone_moves_something() {
    for joint in 0..24 {
        let own: f32 =
            (0..BODY.num_vertices()).flat_map(|v| BODY.weights.row(v)).filter(|e| e.0 == joint).map(|e| e.1).sum();
        assert!(own > 10.0, "joint {joint} has {own} vertices");
    }
}

#[test]
fn every_beta_does_something_smooth_and_bounded() {
    let plain = BODY.shaped(&[]);
    for beta in 0..10 {
        for sign in [-2.0, 2.0] {
            let mut betas = [0.0; 10];
            betas[beta] = sign;
            let shaped = BODY.shaped(&betas);
            let moved = |v: usize| shaped.vertices[v].distance(plain.vertices[v]);
            let most = (0..plain.vertices.len()).map(moved).fold(0.0, f32::max);
            assert!((0.008..0.12).contains(&most), "beta {beta} moves by {most}");
            let litres = 1e3 * mesh(shaped.vertices.clone()).volume();
            println!("beta {beta} at {sign}: {litres:.1} l");
            assert!((40.0..95.0).contains(&litres));
            let normal = |p: &[Vec3], face: &[u32; 3]| {
                let [a, b, c] = face.map(|i| p[i as usize]);
                (b - a).cross(c - a)
            };
            let turn = |face| normal(&plain.vertices, face).angle_between(normal(&shaped.vertices, face));
            let folded = BODY.faces.iter().filter(|face| turn(face) > 1.5).count();
            assert!(folded < 20, "beta {beta} folds {folded} faces over");
        }
    }
}

#[test]
fn bent_limbs_keep_their_volume() {
    let shaped = BODY.shaped(&[]);
    let mut plain_model = BODY.clone();
    plain_model.posedirs = smpl::SparseRows::from_rows((0..BODY.num_vertices()).map(|_| None));
    let rest = mesh(shaped.vertices.clone()).volume();
    for (name, joint, rotation) in [
        ("knee", 4, Vec3::new(1.2, 0.0, 0.0)),
        ("elbow", 18, Vec3::new(0.0, -1.2, 0.0)),
        ("hip", 1, Vec3::new(-1.0, 0.0, 0.0)),
        ("arm down", 16, Vec3::new(0.0, 0.0, -1.2)),
        ("twist", 20, Vec3::new(1.2, 0.0, 0.0)),
    ] {
        let mut pose = vec![Vec3::ZERO; 24];
        pose[joint] = rotation;
        let volume = |model: &BodyModel| {
            let posed = model.pose(&shaped, &pose, Placement::default());
            1e6 * (mesh(posed.vertices).volume() - rest)
        };
        let (with, without) = (volume(&BODY), volume(&plain_model));
        println!("{name}: {with:.0} cm³ with, {without:.0} cm³ without blend shapes");
        assert!(with.abs() < 900.0 && with > without, "{name}: {with} {without}");
    }
}
