//! The Pareto front: what nothing else beats in both respects.

/// Whether each point (cost, worth) is on the front: no other has at most its cost and at least its
/// worth, and one of the two strictly. Equal points stand or fall together; a point that is not
/// finite is never on it.
pub fn front(points: &[(f64, f64)]) -> Vec<bool> {
    let finite = |p: &(f64, f64)| p.0.is_finite() && p.1.is_finite();
    // −0 becomes 0, which sorts otherwise.
    let points: Vec<(f64, f64)> = points.iter().map(|p| (p.0 + 0.0, p.1 + 0.0)).collect();
    let mut order: Vec<usize> = (0..points.len()).filter(|&i| finite(&points[i])).collect();
    // Cheapest first; of equal cost the worthiest first.
    order.sort_by(|&a, &b| points[a].0.total_cmp(&points[b].0).then(points[b].1.total_cmp(&points[a].1)));
    let mut on = vec![false; points.len()];
    let mut best: Option<(f64, f64)> = None;
    for i in order {
        let point = points[i];
        if best.is_none_or(|b| point.1 > b.1 || point == b) {
            on[i] = true;
            best = Some(point);
        }
    }
    on
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn dominates(a: (f64, f64), b: (f64, f64)) -> bool {
        a.0 <= b.0 && a.1 >= b.1 && (a.0 < b.0 || a.1 > b.1)
    }

    #[test]
    fn of_nothing_there_is_no_front_and_what_is_not_finite_is_not_on_it() {
        assert!(front(&[]).is_empty());
        assert_eq!(front(&[(f64::NAN, 1.0), (1.0, f64::INFINITY), (2.0, 2.0)]), [false, false, true]);
        assert_eq!(front(&[(1.0, 1.0), (1.0, 1.0), (0.0, 0.0), (-0.0, 0.0)]), [true; 4]);
    }

    proptest! {
        // Few distinct values, so that ties are common.
        #[test]
        fn no_point_of_the_front_is_dominated_and_every_other_is(
            raw in prop::collection::vec((0u8..12, 0u8..12), 0..40),
        ) {
            let points: Vec<(f64, f64)> = raw.iter().map(|&(x, y)| (f64::from(x), f64::from(y))).collect();
            let on = front(&points);
            for (i, &point) in points.iter().enumerate() {
                let beaten = points.iter().any(|&other| dominates(other, point));
                prop_assert_eq!(on[i], !beaten, "{:?}", point);
            }
            prop_assert_eq!(points.is_empty(), !on.contains(&true));
        }
    }
}
