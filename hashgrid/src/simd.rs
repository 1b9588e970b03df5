/// A kernel to be compiled for the widest instructions of the machine it runs on.
///
/// It takes `FnMut`, whose call is the closure's own body: `FnOnce`, which [`pulp::Arch::dispatch`]
/// takes, goes through a shim that is compiled for the baseline.
pub(crate) struct Kernel<F>(pub F);

impl<R, F: FnMut() -> R> pulp::WithSimd for Kernel<F> {
    type Output = R;

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(mut self, _: S) -> R {
        (self.0)()
    }
}

/// AVX2 on x86-64, also where `pulp` is built with AVX-512 and the machine has it: rows are put
/// together from pieces of 8 bytes, which do not go into wider registers any faster.
pub(crate) fn arch() -> pulp::Arch {
    #[cfg(target_arch = "x86_64")]
    if let Some(simd) = pulp::x86::V3::try_new() {
        return pulp::Arch::V3(simd);
    }
    pulp::Arch::new()
}
