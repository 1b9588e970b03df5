//! Resolutions, table sizes and errors of configurations.

use approx::assert_abs_diff_eq;
use hashgrid::{HashGrid, HashGridConfig, MAX_RESOLUTION};
use proptest::prelude::*;

const CONFIG: HashGridConfig = HashGridConfig { levels: 16, features: 2, log2_table_size: 19, n_min: 16, n_max: 2048 };

#[test]
fn resolutions_grow_geometrically_from_n_min_to_n_max() {
    // b = 2: rounding must not lower the integers.
    let config = HashGridConfig { levels: 8, n_max: 2048, ..CONFIG };
    let grid = HashGrid::<3>::new(&config).unwrap();
    assert_eq!(grid.resolutions(), [16, 32, 64, 128, 256, 512, 1024, 2048]);
    assert_eq!(grid.num_features(), 16);

    let grid = HashGrid::<3>::new(&CONFIG).unwrap();
    assert_eq!(grid.resolutions()[..3], [16, 22, 30]);
    assert_eq!(grid.resolutions()[15], 2048);

    let one = HashGridConfig { levels: 1, ..CONFIG };
    assert_eq!(HashGrid::<2>::new(&one).unwrap().resolutions(), [16]);
    let flat = HashGridConfig { n_max: 16, levels: 3, ..CONFIG };
    assert_eq!(HashGrid::<2>::new(&flat).unwrap().resolutions(), [16; 3]);
}

#[test]
fn dense_levels_have_a_row_per_corner_and_hashed_ones_the_table_size() {
    let grid = HashGrid::<4>::with_resolutions(&[1, 15, 16, 2048], 2, 16).unwrap();
    assert_eq!(grid.level_range(0), 0..32);
    assert_eq!(grid.level_range(1), 32..32 + (2 << 16));
    assert_eq!(grid.level_range(2).len(), 2 << 16);
    assert_eq!(grid.num_parameters(), grid.level_range(3).end);
}

#[test]
fn levels_whose_corner_count_overflows_u64_are_hashed() {
    // (2^24 + 1)^4 overflows u64; 65536^4 = 2^64 would wrap to 0, which would fit.
    for resolution in [MAX_RESOLUTION, (1 << 16) - 1, 1 << 16] {
        let grid = HashGrid::<4>::with_resolutions(&[resolution], 1, 10).unwrap();
        assert_eq!(grid.num_parameters(), 1024);
    }
}

#[test]
fn settings_out_of_range_are_errors() {
    let refused = |config, expected: &str| {
        assert_eq!(HashGrid::<4>::new(&config).unwrap_err().to_string(), expected);
    };
    refused(HashGridConfig { levels: 0, ..CONFIG }, "levels: 0, expected 1 to 64");
    refused(HashGridConfig { levels: 1 << 40, ..CONFIG }, "levels: 1099511627776, expected 1 to 64");
    refused(HashGridConfig { features: 0, ..CONFIG }, "features: 0, expected 1 to 256");
    refused(HashGridConfig { features: 257, ..CONFIG }, "features: 257, expected 1 to 256");
    for t in [29, 40, 64, u32::MAX] {
        let expected = format!("log2_table_size: {t}, expected 0 to 28");
        refused(HashGridConfig { log2_table_size: t, ..CONFIG }, &expected);
    }
    refused(HashGridConfig { n_max: 15, ..CONFIG }, "n_max: 15, expected 16 to 16777216");
    refused(HashGridConfig { n_min: 0, ..CONFIG }, "n_min: 0, expected 1 to 16777216");
    refused(HashGridConfig { n_max: u32::MAX, ..CONFIG }, "n_max: 4294967295, expected 16 to 16777216");
    let huge = HashGridConfig { features: 256, log2_table_size: 28, ..CONFIG };
    let error = HashGrid::<4>::new(&huge).unwrap_err().to_string();
    assert!(error.starts_with("number of parameters: ") && error.ends_with(", expected 0 to 2147483648"), "{error}");
    assert_eq!(HashGrid::<2>::with_resolutions(&[], 1, 1).unwrap_err().to_string(), "levels: 0, expected 1 to 64");
    let error = HashGrid::<2>::with_resolutions(&[4, 0], 1, 1).unwrap_err();
    assert_eq!(error.to_string(), "resolution of level 1: 0, expected 1 to 16777216");
}

#[test]
fn the_initial_table_is_uniform_and_determined_by_the_seed() {
    let grid = HashGrid::<3>::new(&HashGridConfig { levels: 4, log2_table_size: 12, ..CONFIG }).unwrap();
    let table = grid.init_table(1);
    assert_eq!(table.len(), grid.num_parameters());
    assert!(table.iter().all(|x| x.abs() <= 1e-4));
    let mean = table.iter().map(|&x| f64::from(x)).sum::<f64>() / table.len() as f64;
    let variance = table.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>() / table.len() as f64;
    // A uniform distribution in ±a has variance a² / 3; 32 k samples.
    assert!(mean.abs() < 2e-6, "{mean}");
    assert_abs_diff_eq!(variance / (1e-8 / 3.0), 1.0, epsilon = 0.03);
    assert_eq!(table, grid.init_table(1));
    assert_ne!(table, grid.init_table(2));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    #[test]
    fn every_configuration_gives_a_grid_within_its_limits_or_an_error(
        levels in 0usize..70, features in 0usize..300, log2_table_size in 0u32..34, n_min: u32, n_max: u32,
    ) {
        let config = HashGridConfig { levels, features, log2_table_size, n_min: n_min >> 8, n_max: n_max >> 7 };
        if let Ok(grid) = HashGrid::<4>::new(&config) {
            let resolutions = grid.resolutions();
            prop_assert_eq!(resolutions.len(), levels);
            prop_assert_eq!(resolutions[0], config.n_min);
            prop_assert!(resolutions.is_sorted());
            prop_assert!(levels == 1 || resolutions[levels - 1] == config.n_max);
            prop_assert!(grid.num_parameters() <= (levels * features) << log2_table_size);
        }
    }
}
