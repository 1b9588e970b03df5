/// Closure that [`pulp::Arch::dispatch`] compiles for each instruction set.
///
/// `FnMut` inlines the closure's body; `FnOnce`, which `dispatch` accepts directly, calls it through
/// a shim compiled for the baseline.
pub(crate) struct Kernel<F>(pub F);

impl<R, F: FnMut() -> R> pulp::WithSimd for Kernel<F> {
    type Output = R;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(mut self, _: S) -> R {
        (self.0)()
    }
}
