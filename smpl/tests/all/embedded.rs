//! The embedded body is a closed, well-formed, plausible human.

use std::collections::{HashMap, HashSet};
use std::sync::LazyLock;

use glam::Vec3;
use smpl::BodyModel;

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
