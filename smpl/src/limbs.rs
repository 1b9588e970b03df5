//! Limb lengths as shape blend shapes.

use glam::Vec3;

use crate::model::BodyModel;

/// Distance from the plane of symmetry beyond which a joint belongs to a limb, and within which a
/// joint's mirror image is matched, as a fraction of the body's height.
const ASIDE: f32 = 0.018;
/// Number of shape blend shapes up to which [`BodyModel::with_limb_lengths`] adds some.
const SHAPES: usize = 10;
/// Relative lengthening of a bone by a coefficient of 1.
const LONGER: f32 = 0.1;

/// The bones of a body's limbs: those that begin and end off the plane of symmetry, x = 0.
///
/// A bone is identified by the joint at its end, a left–right pair by the lower of its two joints.
///
/// ```
/// let body = smpl::BodyModel::embedded();
/// let limbs = body.limbs();
/// let longest = limbs.pairs()[0];
/// assert_eq!(longest, 7); // the shins, which end at the ankles
/// // 5 % longer shins:
/// let mut taller = body.clone();
/// taller.v_template.iter_mut().zip(limbs.longer(longest)).for_each(|(v, d)| *v += 0.05 * d);
/// ```
#[derive(Clone, Debug)]
pub struct Limbs<'a> {
    body: &'a BodyModel,
    joints: Vec<Vec3>,
    /// Pair of the bone that ends at each joint, (J); `None` for bones outside limbs.
    pairs: Vec<Option<usize>>,
}

impl BodyModel {
    /// The bones of the limbs, in the rest pose with zero betas.
    pub fn limbs(&self) -> Limbs<'_> {
        let joints = self.shaped(&[]).joints;
        let height = |pick: fn(f32, f32) -> f32| self.v_template.iter().map(|v| v.y).reduce(pick).unwrap_or(0.0);
        let aside = ASIDE * (height(f32::max) - height(f32::min));
        let is_aside = |j: usize| joints[j].x.abs() > aside;
        let mut pairs: Vec<Option<usize>> = Vec::with_capacity(joints.len());
        for (j, parent) in self.parents.iter().enumerate() {
            let mirrored = joints[j] * Vec3::new(-1.0, 1.0, 1.0);
            let is_twin = |&k: &usize| pairs[k].is_some() && joints[k].distance(mirrored) < aside;
            let pair = || (0..j).find(is_twin).map_or(Some(j), |twin| pairs[twin]);
            pairs.push(if is_aside(j) && parent.is_some_and(is_aside) { pair() } else { None });
        }
        Limbs { body: self, joints, pairs }
    }

    /// Adds the lengths of the longest limbs as shape blend shapes, 10 % per unit of coefficient,
    /// up to ten shapes in all. Made for rigged characters, which have none of their own.
    #[must_use]
    pub fn with_limb_lengths(mut self) -> Self {
        let limbs = self.limbs();
        let room = SHAPES.saturating_sub(self.num_betas());
        let longer: Vec<Vec3> = limbs.pairs().into_iter().take(room).flat_map(|pair| limbs.longer(pair)).collect();
        self.shapedirs.extend(longer.into_iter().map(|v| LONGER * v));
        self
    }
}

impl Limbs<'_> {
    /// The pairs, longest bones first.
    pub fn pairs(&self) -> Vec<usize> {
        let mut pairs: Vec<usize> = (0..self.pairs.len()).filter(|&j| self.pairs[j] == Some(j)).collect();
        pairs.sort_by(|&a, &b| self.bone(b).length().total_cmp(&self.bone(a).length()));
        pairs
    }

    /// Derivative of the rest vertices, (V), with respect to the relative length of a pair's bones:
    /// vertices of descendant joints translate, those along the bones are stretched. Contributions
    /// of several pairs add.
    pub fn longer(&self, pair: usize) -> Vec<Vec3> {
        let mut moved = vec![Vec3::ZERO; self.joints.len()];
        // Bone to stretch along, by its first joint. A limb that forks is stretched along the first
        // branch.
        let mut stretched: Vec<Option<Vec3>> = vec![None; self.joints.len()];
        let mut forks = vec![false; self.joints.len()];
        for (j, parent) in self.body.parents.iter().enumerate() {
            let Some(p) = *parent else { continue };
            moved[j] = moved[p];
            if self.pairs[j] == Some(pair) {
                moved[j] += self.bone(j);
                stretched[p] = Some(self.bone(j)).filter(|_| !forks[p]);
            }
            forks[p] |= self.pairs[j].is_some();
        }
        let of = |(v, at): (usize, &Vec3)| {
            let motion = |(j, weight): (usize, f32)| {
                let along = stretched[j].map_or(Vec3::ZERO, |bone| {
                    let part = (*at - self.joints[j]).dot(bone) / bone.length_squared().max(f32::MIN_POSITIVE);
                    part.clamp(0.0, 1.0) * bone
                });
                weight * (moved[j] + along)
            };
            self.body.weights.row(v).map(motion).sum()
        };
        self.body.v_template.iter().enumerate().map(of).collect()
    }

    /// Vector from the parent of `joint` to it.
    fn bone(&self, joint: usize) -> Vec3 {
        self.body.parents[joint].map_or(Vec3::ZERO, |p| self.joints[joint] - self.joints[p])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SparseRows;

    /// The embedded body without shapes of its own.
    fn bare() -> BodyModel {
        BodyModel { shapedirs: Vec::new(), ..BodyModel::embedded() }
    }

    #[test]
    fn each_pair_becomes_as_much_longer_as_asked_and_nothing_else_does() {
        let body = bare();
        let limbs = body.limbs();
        // Thighs, shins and feet; upper arms, forearms and hands of SMPL.
        let mut pairs = limbs.pairs();
        let length = |joints: &[Vec3], j: usize| joints[j].distance(joints[body.parents[j].unwrap()]);
        let (before, sorted) = (body.shaped(&[]).joints, pairs.clone());
        assert!(sorted.windows(2).all(|pair| length(&before, pair[0]) >= length(&before, pair[1])));
        pairs.sort_unstable();
        assert_eq!(pairs, [4, 7, 10, 18, 20, 22]);
        for pair in pairs {
            let mut longer = body.clone();
            longer.v_template.iter_mut().zip(limbs.longer(pair)).for_each(|(v, by)| *v += 0.1 * by);
            longer.validate("longer").unwrap();
            let after = longer.shaped(&[]).joints;
            for j in 1..after.len() {
                let part = length(&after, j) / length(&before, j) - 1.0;
                let asked = if limbs.pairs[j] == Some(pair) { 0.1 } else { 0.0 };
                // Joints are regressed from vertices that not only their own bones move.
                assert!((part - asked).abs() < 0.035, "{pair}, {j}: {part}");
            }
        }
    }

    #[test]
    fn bodies_without_shapes_get_their_limbs_and_others_stay_as_they_are() {
        let body = bare().with_limb_lengths();
        body.validate("limbs").unwrap();
        assert_eq!(body.num_betas(), 6);
        assert_eq!(BodyModel::embedded().with_limb_lengths(), BodyModel::embedded());
        let longest = body.limbs().pairs()[0];
        let part = |betas: &[f32]| {
            let joints = body.shaped(betas).joints;
            joints[longest].distance(joints[longest - 3])
        };
        assert!((part(&[0.5]) / part(&[]) - 1.05).abs() < 0.01);
    }

    /// A body whose joints are its first vertices.
    fn skeleton(places: &[Vec3], parents: &[Option<usize>]) -> BodyModel {
        let one = |joint: usize| [(joint as u32, 1.0)];
        BodyModel {
            v_template: places.to_vec(),
            faces: vec![[0, 1, 2]],
            shapedirs: Vec::new(),
            posedirs: SparseRows::from_rows(places.iter().map(|_| None::<(u32, Vec3)>)),
            weights: SparseRows::from_rows((0..places.len()).map(|v| one(v.min(parents.len() - 1)))),
            j_regressor: SparseRows::from_rows((0..parents.len()).map(one)),
            parents: parents.to_vec(),
        }
    }

    #[test]
    fn a_bone_without_a_twin_is_a_limb_of_its_own_and_a_body_without_limbs_has_none() {
        let place = |x: f32, y: f32| Vec3::new(x, y, 0.0);
        let places = [place(0.0, 0.0), place(-0.4, 0.5), place(0.2, 0.5), place(0.4, 0.5), place(0.0, 1.0)];
        // What lies opposite the last joint ends no limb: its bone begins in the middle.
        let body = skeleton(&places, &[None, Some(0), Some(0), Some(2)]);
        assert_eq!(body.limbs().pairs(), [3]);
        assert_eq!(body.limbs().longer(3)[3], place(0.2, 0.0));
        let single = skeleton(&places[..3], &[None]);
        assert_eq!(single.clone().with_limb_lengths(), single);
    }
}
