//! The embedded body is a closed, well-formed, plausible human.

use std::collections::HashSet;
use std::sync::LazyLock;

use glam::Vec3;
use smpl::BodyModel;

static BODY: LazyLock<BodyModel> = LazyLock::new(BodyModel::embedded);

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
    let mesh = testkit::TriMesh { vertices: BODY.v_template.clone(), faces: BODY.faces.clone() };
    assert!(mesh.is_closed());
    let v = BODY.num_vertices() as i64;
    let f = BODY.faces.len() as i64;
    assert_eq!(v - f * 3 / 2 + f, 2, "Euler characteristic of a sphere");
    assert_eq!(BODY.faces.iter().flatten().collect::<HashSet<_>>().len() as i64, v, "a stray vertex");
}
