const PRIMES: [u32; 4] = [1, 2_654_435_761, 805_459_861, 3_674_653_429];

/// Row of a level's table that holds grid corner `corner` (D), for a level of `resolution` cells an
/// axis.
///
/// Dense, Σ c_j (N+1)^j, where the level's (N+1)^D corners fit 2^T rows; else the XOR of c_j · π_j
/// in wrapping u32, modulo 2^T (Müller et al. 2022, eq. 4).
///
/// # Panics
/// For more than 4 dimensions.
#[must_use]
pub fn hash_index(corner: &[u32], resolution: u32, log2_table_size: u32) -> usize {
    assert!(corner.len() <= PRIMES.len(), "hash_index: {} dimensions, at most {}", corner.len(), PRIMES.len());
    let side = u128::from(resolution) + 1;
    let rows = 1u128 << log2_table_size;
    if side.pow(corner.len() as u32) <= rows {
        let mut index = 0;
        for &c in corner.iter().rev() {
            index = index * side + u128::from(c);
        }
        return index as usize;
    }
    let mut hash = 0u32;
    for (c, prime) in corner.iter().zip(PRIMES) {
        hash ^= c.wrapping_mul(prime);
    }
    (u128::from(hash) % rows) as usize
}

/// Multiresolution hash encoding: `points` (Q × `dims`, from 0 to 1; clamped, NaN as 0), `table`
/// (L, 2^T, F) padded, one entry of `resolutions` a level; returns (Q, L·F), level by level.
///
/// # Panics
/// Where lengths do not fit each other.
#[must_use]
pub fn hash_encode(
    points: &[f64],
    dims: usize,
    resolutions: &[u32],
    table: &[f32],
    log2_table_size: u32,
    features: usize,
) -> Vec<f64> {
    let rows = 1usize << log2_table_size;
    assert_eq!(table.len(), resolutions.len() * rows * features, "hash_encode: table is not (L, 2^T, F)");
    assert_eq!(points.len() % dims, 0, "hash_encode: points are not (Q, {dims})");
    let mut encoded = Vec::new();
    for point in points.chunks(dims) {
        for (level, &resolution) in resolutions.iter().enumerate() {
            let mut cell = vec![0u32; dims];
            let mut fraction = vec![0.0f64; dims];
            for j in 0..dims {
                let x = if point[j].is_nan() { 0.0 } else { point[j].clamp(0.0, 1.0) };
                let p = x * f64::from(resolution);
                cell[j] = (p.floor() as u32).min(resolution - 1);
                fraction[j] = p - f64::from(cell[j]);
            }
            let mut sum = vec![0.0f64; features];
            for mask in 0..1usize << dims {
                let mut weight = 1.0;
                let mut corner = cell.clone();
                for j in 0..dims {
                    if mask >> j & 1 == 1 {
                        corner[j] += 1;
                        weight *= fraction[j];
                    } else {
                        weight *= 1.0 - fraction[j];
                    }
                }
                let row = level * rows + hash_index(&corner, resolution, log2_table_size);
                for f in 0..features {
                    sum[f] += weight * f64::from(table[row * features + f]);
                }
            }
            encoded.extend(sum);
        }
    }
    encoded
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_abs_diff_eq;

    #[test]
    fn a_dense_level_interpolates_a_linear_function_exactly() {
        // 4 cells an axis in 2-D: 25 corners fit 2^5 rows. f = 3x − 2y + 1 at corner (i, j) / 4.
        let mut table = vec![0.0f32; 32];
        for j in 0..5 {
            for i in 0..5 {
                table[j * 5 + i] = 3.0 * i as f32 / 4.0 - 2.0 * j as f32 / 4.0 + 1.0;
            }
        }
        for (x, y) in [(0.0, 0.0), (1.0, 1.0), (0.3, 0.77), (1.0, 0.0), (0.25, 0.5)] {
            let got = hash_encode(&[x, y], 2, &[4], &table, 5, 1)[0];
            assert_abs_diff_eq!(got, (3.0 * x - 2.0 * y + 1.0), epsilon = 1e-6);
        }
    }

    #[test]
    fn fine_levels_hash_by_xor_of_primes() {
        assert_eq!(hash_index(&[5, 0, 0], 64, 10), 5);
        assert_eq!(hash_index(&[0, 1, 0], 64, 10), (2_654_435_761u64 % 1024) as usize);
        let two = 2u32.wrapping_mul(2_654_435_761);
        assert_eq!(hash_index(&[1, 2], 64, 8), ((1 ^ two) % 256) as usize);
        // (N+1)^D is exactly the table size: dense.
        assert_eq!(hash_index(&[1, 1], 3, 4), 5);
    }

    #[test]
    fn outside_is_clamped_and_nan_is_zero() {
        let table: Vec<f32> = (0..16).map(|i| i as f32).collect();
        let at = |x: f64, y: f64| hash_encode(&[x, y], 2, &[3], &table, 4, 1)[0];
        assert_eq!(at(-1.0, 7.0), at(0.0, 1.0));
        assert_eq!(at(f64::NAN, 0.5), at(0.0, 0.5));
    }
}
