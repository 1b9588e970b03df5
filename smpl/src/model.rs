//! The body model: its arrays, their checks, and the shape step.

use glam::Vec3;

use crate::Error;
use crate::sparse::SparseRows;

/// Pose blend-shape terms a non-root joint: the entries of R − I.
pub(crate) const TERMS_PER_JOINT: usize = 9;
/// Largest coordinate of a body or mesh, in its own unit: a kilometre in millimetres.
pub(crate) const MAX_COORDINATE: f32 = 1e6;

/// A body in SMPL's form: V vertices, J joints, B shape and P pose blend shapes.
///
/// Lengths are in the model's own unit. All fields are public, so that a body can be assembled from
/// any source; [`BodyModel::validate`] checks that the parts fit.
///
/// ```
/// use glam::Vec3;
/// use smpl::{BodyModel, SparseRows};
///
/// // One triangle on one joint.
/// let body = BodyModel {
///     v_template: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
///     faces: vec![[0, 1, 2]],
///     shapedirs: Vec::new(),
///     posedirs: SparseRows::from_rows([[]; 3]),
///     weights: SparseRows::from_rows([[(0, 1.0)]; 3]),
///     j_regressor: SparseRows::from_rows([[(0, 0.5), (1, 0.5)]]),
///     parents: vec![None],
/// };
/// body.validate("triangle").unwrap();
/// assert_eq!(body.shaped(&[]).joints, [Vec3::new(0.5, 0.0, 0.0)]);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct BodyModel {
    /// Template, (V).
    pub v_template: Vec<Vec3>,
    /// Triangles, (F), counter-clockwise seen from outside.
    pub faces: Vec<[u32; 3]>,
    /// Shape blend shapes, (B·V): those of β_0 first, V each.
    pub shapedirs: Vec<Vec3>,
    /// Pose blend shapes, (V, P): row v holds the terms that move vertex v. Term 9(j−1) + 3r + c
    /// belongs to entry (r, c) of R(θ_j) − I. P is 9(J−1), or no row has any entry.
    pub posedirs: SparseRows<Vec3>,
    /// Skinning weights, (V, J), rows non-negative and summing to 1.
    pub weights: SparseRows<f32>,
    /// Joint regressor, (J, V), rows summing to 1.
    pub j_regressor: SparseRows<f32>,
    /// Parent of each joint, (J): `None` for joint 0, a smaller index for all others.
    pub parents: Vec<Option<usize>>,
}

/// The rest pose of one person: template plus shape blend shapes, from [`BodyModel::shaped`].
///
/// ```
/// let body = smpl::BodyModel::embedded();
/// let [short, tall] = [-1.0, 1.0].map(|height| body.shaped(&[height]));
/// assert!(tall.joints[15].y - tall.joints[10].y > short.joints[15].y - short.joints[10].y);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Shaped {
    /// Vertices in the rest pose, (V).
    pub vertices: Vec<Vec3>,
    /// Joints in the rest pose, (J).
    pub joints: Vec<Vec3>,
}

impl BodyModel {
    /// Number of vertices, V.
    pub fn num_vertices(&self) -> usize {
        self.v_template.len()
    }

    /// Number of joints, J.
    pub fn num_joints(&self) -> usize {
        self.parents.len()
    }

    /// Number of shape coefficients, B.
    pub fn num_betas(&self) -> usize {
        self.shapedirs.len() / self.num_vertices().max(1)
    }

    /// Applies the shape blend shapes, template + B_S(β), and regresses the joints from the result.
    /// Missing betas are 0.
    ///
    /// ```
    /// let body = smpl::BodyModel::embedded();
    /// let height = |betas: &[f32]| {
    ///     let vertices = body.shaped(betas).vertices;
    ///     vertices.iter().map(|v| v.y).fold(f32::MIN, f32::max) - vertices.iter().map(|v| v.y).fold(f32::MAX, f32::min)
    /// };
    /// assert!(height(&[1.0]) > height(&[]) + 0.05);
    /// ```
    ///
    /// # Panics
    /// With more betas than [`BodyModel::num_betas`].
    pub fn shaped(&self, betas: &[f32]) -> Shaped {
        assert!(betas.len() <= self.num_betas(), "shaped: {} betas, the model has {}", betas.len(), self.num_betas());
        let mut vertices = self.v_template.clone();
        for (&beta, directions) in betas.iter().zip(self.shapedirs.chunks(vertices.len().max(1))) {
            if beta != 0.0 {
                for (v, &d) in vertices.iter_mut().zip(directions) {
                    *v += beta * d;
                }
            }
        }
        let joints = (0..self.j_regressor.num_rows())
            .map(|j| {
                let mut sum = glam::DVec3::ZERO;
                for (v, w) in self.j_regressor.row(j) {
                    sum += f64::from(w) * vertices[v].as_dvec3();
                }
                sum.as_vec3()
            })
            .collect();
        Shaped { vertices, joints }
    }

    /// Checks that the parts fit together, that there is a surface, and that every value is finite
    /// and below 10⁶ units. `file` names the model in errors; keys are those of SMPL's files.
    ///
    /// # Errors
    /// [`Error::Invalid`].
    pub fn validate(&self, file: &str) -> Result<(), Error> {
        let invalid = |key: &str, message: String| Err(Error::invalid(file, key, message));
        let (v, j) = (self.num_vertices(), self.num_joints());
        if v == 0 {
            return invalid("v_template", "no vertices".to_owned());
        }
        check_vectors(file, "v_template", &self.v_template)?;
        for (i, face) in self.faces.iter().enumerate() {
            if let Some(bad) = face.iter().find(|&&index| index as usize >= v) {
                return invalid("f", format!("face {i} names vertex {bad} of {v}"));
            }
        }
        if !self.shapedirs.len().is_multiple_of(v) {
            let n = self.shapedirs.len();
            return invalid("shapedirs", format!("{n} directions for {v} vertices"));
        }
        let vertex = |i: u32| self.v_template[i as usize].as_dvec3();
        let area = |f: &[u32; 3]| (vertex(f[1]) - vertex(f[0])).cross(vertex(f[2]) - vertex(f[0])).length();
        if !self.faces.iter().any(|face| area(face) > 0.0) {
            let fault = if self.faces.is_empty() { "no faces" } else { "all faces are degenerate" };
            return invalid("f", fault.to_owned());
        }
        check_vectors(file, "shapedirs", &self.shapedirs)?;
        if self.parents.first() != Some(&None) {
            return invalid("kintree_table", "joint 0 is not the root".to_owned());
        }
        for (i, &parent) in self.parents.iter().enumerate().skip(1) {
            if parent.is_none_or(|p| p >= i) {
                let found = parent.map_or("none".to_owned(), |parent| parent.to_string());
                let message = format!("parent of joint {i} is {found}, expected a joint before it");
                return invalid("kintree_table", message);
            }
        }
        let terms = TERMS_PER_JOINT * (j - 1);
        for (key, fault) in [
            ("posedirs", self.posedirs.fault(v, terms)),
            ("weights", self.weights.fault(v, j)),
            ("J_regressor", self.j_regressor.fault(j, v)),
        ] {
            if let Some(message) = fault {
                return invalid(key, message);
            }
        }
        // Posing reads a row of P entries as dense.
        let ascends = |row: usize| self.posedirs.row(row).zip(self.posedirs.row(row).skip(1)).all(|(a, b)| a.0 < b.0);
        if let Some(row) = (0..v).find(|&row| !ascends(row)) {
            return invalid("posedirs", format!("columns of row {row} do not ascend"));
        }
        check_vectors(file, "posedirs", &self.posedirs.values)?;
        for i in 0..v {
            let mut sum = 0.0;
            for (_, w) in self.weights.row(i) {
                // Rejects NaN as well.
                if !(0.0..=1.01).contains(&w) {
                    return invalid("weights", format!("vertex {i} has a weight of {w}"));
                }
                sum += w;
            }
            if (sum - 1.0).abs() > 1e-3 {
                return invalid("weights", format!("those of vertex {i} sum to {sum}"));
            }
        }
        for i in 0..j {
            let sum: f32 = self.j_regressor.row(i).map(|(_, w)| w).sum();
            if sum.is_nan() || (sum - 1.0).abs() > 1e-2 {
                return invalid("J_regressor", format!("row {i} sums to {sum}"));
            }
        }
        Ok(())
    }
}

/// Checks that every vector is finite and, for the precision of `f32`, below [`MAX_COORDINATE`].
pub(crate) fn check_vectors(file: &str, key: &str, values: &[Vec3]) -> Result<(), Error> {
    for (i, v) in values.iter().enumerate() {
        if !v.is_finite() {
            return Err(Error::invalid(file, key, format!("not finite at flat index {}", 3 * i)));
        }
        if v.abs().max_element() > MAX_COORDINATE {
            let message = format!("{v} at row {i}, expected coordinates of at most {MAX_COORDINATE}");
            return Err(Error::invalid(file, key, message));
        }
    }
    Ok(())
}
