//! Farthest point sampling against the plain algorithm.

use glam::Vec3;
use proptest::prelude::*;
use surface_query::{Pyramid, farthest_points};
use testkit::{oracle, strategy};

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn sampling_equals_the_plain_algorithm(
        points in strategy::cloud(0..250, 1.0), share in 0.0f32..1.2,
    ) {
        let count = (points.len() as f32 * share) as usize;
        prop_assert_eq!(farthest_points(&points, count), oracle::farthest_points(&points, count));
    }

    #[test]
    fn sampling_a_lattice_breaks_every_tie_by_index(
        order in Just((0..216u32).collect::<Vec<_>>()).prop_shuffle(),
    ) {
        let points: Vec<Vec3> = (order.iter())
            .map(|&i| Vec3::new((i % 6) as f32, (i / 6 % 6) as f32, (i / 36) as f32))
            .collect();
        prop_assert_eq!(farthest_points(&points, 216), oracle::farthest_points(&points, 216));
    }

    #[test]
    fn a_level_is_the_sampling_of_the_level_above(
        points in strategy::cloud(20..250, 1.0), ratio in 0.125f32..0.9,
    ) {
        let pyramid = Pyramid::new(&points, ratio, 3);
        prop_assert_eq!(pyramid.levels.len(), 4);
        prop_assert_eq!(&pyramid.levels[0], &(0..points.len() as u32).collect::<Vec<_>>());
        for pair in pyramid.levels.windows(2) {
            let above: Vec<Vec3> = pair[0].iter().map(|&i| points[i as usize]).collect();
            let sampled: Vec<u32> = (oracle::farthest_points(&above, pair[1].len()).into_iter())
                .map(|local| pair[0][local as usize])
                .collect();
            prop_assert_eq!(&pair[1], &sampled);
        }
    }
}

#[test]
fn sampling_degenerate_clouds_gives_distinct_indices_and_takes_bad_points_last() {
    for (name, points) in strategy::degenerate_clouds() {
        let all = farthest_points(&points, points.len() + 3);
        let finite = points.iter().filter(|p| p.is_finite()).count();
        let mut sorted = all.clone();
        sorted.sort_unstable();
        assert_eq!(sorted, (0..points.len() as u32).collect::<Vec<_>>(), "{name}");
        for (position, &i) in all.iter().enumerate() {
            assert_eq!(points[i as usize].is_finite(), position < finite, "{name}");
        }
        if finite == points.len() {
            assert_eq!(all, oracle::farthest_points(&points, points.len()), "{name}");
        }
    }
}

#[test]
fn ratios_that_f32_rounds_down_give_the_decimal_size_and_a_body_the_levels_of_the_paper() {
    let sizes = |n: usize, ratio| {
        let points: Vec<Vec3> = (0..n).map(|i| Vec3::X * i as f32).collect();
        Pyramid::new(&points, ratio, 3).levels.iter().map(Vec::len).collect::<Vec<_>>()
    };
    let size = |ratio| sizes(10, ratio)[1];
    assert_eq!([0.7, 0.3, 0.1, 1.0, 0.0, 7.0, f32::NAN].map(size), [7, 3, 1, 10, 1, 10, 10]);
    assert_eq!(sizes(6890, 0.25), [6890, 1722, 430, 107]);
    assert_eq!((sizes(3, 0.25), sizes(0, 0.25)), (vec![3, 1, 1, 1], vec![0; 4]));
}
