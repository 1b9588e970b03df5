/// Closure that [`pulp::Arch::dispatch`] compiles for each instruction set.
///
/// `FnMut` inlines the closure's body; `FnOnce`, which `dispatch` accepts directly, calls it
/// through a shim compiled for the baseline.
pub(crate) struct Kernel<F>(pub F);

impl<R, F: FnMut() -> R> pulp::WithSimd for Kernel<F> {
    type Output = R;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(mut self, _: S) -> R {
        (self.0)()
    }
}

/// AVX2 on x86-64 even where AVX-512 is available: rows are gathered in pieces of 8 bytes, which
/// wider registers do not speed up.
pub(crate) fn arch() -> pulp::Arch {
    #[cfg(target_arch = "x86_64")]
    if let Some(simd) = pulp::x86::V3::try_new() {
        return pulp::Arch::V3(simd);
    }
    pulp::Arch::new()
}
